//! The reasons for which a connection is closed: the application error codes of the link protocol.

use std::fmt;

macro_rules! close_codes {
    ($($(#[$doc:meta])* $variant:ident = $code:literal, $name:literal;)*) => {
        /// An application error code with which a link is closed.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum CloseCode {
            $($(#[$doc])* $variant,)*
        }

        impl CloseCode {
            /// Returns the code on the wire.
            pub fn code(self) -> u32 {
                match self { $(Self::$variant => $code,)* }
            }

            /// Returns the code's name in `docs/formats.md`.
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)* }
            }

            /// Returns the variant for `code`, if this version knows it.
            pub fn from_code(code: u64) -> Option<Self> {
                match code { $($code => Some(Self::$variant),)* _ => None }
            }
        }
    };
}

close_codes! {
    /// The daemon ends or no longer needs the link.
    Goodbye = 0x00, "GOODBYE";
    /// Another connection between the same daemons was elected.
    Duplicate = 0x01, "DUPLICATE";
    /// A successor under a new key took over.
    Replaced = 0x02, "REPLACED";
    /// No common protocol version.
    Protocol = 0x10, "PROTOCOL_MISMATCH";
    /// Another ROS domain.
    Domain = 0x11, "DOMAIN_MISMATCH";
    /// `classic` against `qkd`.
    Mode = 0x12, "MODE_MISMATCH";
    /// `session` against `messages10`.
    KeyMode = 0x13, "KEY_MODE_MISMATCH";
    /// `psk_ke` against `psk_dhe_ke`.
    Kex = 0x14, "KEX_MISMATCH";
    /// Different ciphers.
    Cipher = 0x15, "CIPHER_MISMATCH";
    /// Different classic authentication.
    Auth = 0x16, "AUTH_MISMATCH";
    /// The SAE in HELLO is not the one that the PSK was made for.
    Sae = 0x17, "SAE_MISMATCH";
    /// The peer is this daemon itself.
    Self_ = 0x18, "SELF";
    /// READY did not prove knowledge of the announced key.
    Proof = 0x20, "PROOF_FAILED";
    /// A PSK completed a second handshake.
    KeyReused = 0x21, "KEY_REUSED";
    /// An envelope was not accepted.
    Envelope = 0x22, "ENVELOPE_REFUSED";
    /// The KME gave no key.
    KeySupply = 0x23, "KEY_SUPPLY";
    /// Bytes that do not follow the protocol.
    Malformed = 0x30, "MALFORMED";
    /// A frame or message above its limit.
    TooLarge = 0x31, "TOO_LARGE";
    /// A message out of order.
    OutOfOrder = 0x32, "OUT_OF_ORDER";
    /// The peer is not, or no longer, allowed.
    NotAllowed = 0x40, "NOT_ALLOWED";
    /// A defect of the closing side.
    Internal = 0x50, "INTERNAL";
}

impl fmt::Display for CloseCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
