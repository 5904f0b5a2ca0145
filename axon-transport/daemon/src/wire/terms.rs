//! The security settings that two daemons must share before they may link.

use axon_transport::config::{ClassicAuth, Config, KeyMode, QkdKex, QuicCipher, Security};

/// The security settings that beacon and HELLO state, by the codes of their keys 4 to 7 and 12.
///
/// Codes rather than enums: a peer of a later release may send one that this release has no name
/// for, which is a difference to report and not a datagram to drop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SecurityTerms {
    /// 0 classic, 1 qkd.
    pub mode: u8,
    /// 0 none, 1 session, 2 messages10.
    pub key_mode: u8,
    /// 0 X25519MLKEM768, 1 psk_ke, 2 psk_dhe_ke.
    pub kex: u8,
    /// 0 chacha20-poly1305, 1 aes-256-gcm.
    pub cipher: u8,
    /// 0 none, 1 pinned, 2 ca; `None` in qkd.
    pub auth: Option<u8>,
}

/// A setting in which two daemons differ, and both values as the setting spells them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// The variable to look at.
    pub setting: &'static str,
    /// This daemon's value.
    pub ours: String,
    /// The value that the peer states.
    pub theirs: String,
}

const MODES: &[&str] = &["classic", "qkd"];
const KEY_MODES: &[&str] = &["none", "session", "messages10"];
const KEXES: &[&str] = &["X25519MLKEM768", "psk_ke", "psk_dhe_ke"];
const CIPHERS: &[&str] = &["chacha20-poly1305", "aes-256-gcm"];
const AUTHS: &[&str] = &["none", "pinned", "ca"];

impl SecurityTerms {
    /// The code of `qkd` in [`mode`](Self::mode).
    pub const QKD: u8 = 1;

    /// Returns the terms of a daemon with this configuration.
    pub fn of(config: &Config) -> Self {
        let cipher = match config.cipher {
            QuicCipher::ChaCha20Poly1305 => 0,
            QuicCipher::Aes256Gcm => 1,
        };
        match &config.security {
            Security::Classic(classic) => {
                let auth = match classic.auth {
                    ClassicAuth::None => 0,
                    ClassicAuth::Pinned => 1,
                    ClassicAuth::Ca => 2,
                };
                Self { mode: 0, key_mode: 0, kex: 0, cipher, auth: Some(auth) }
            }
            Security::Qkd(qkd) => {
                let key_mode = match qkd.key_mode {
                    KeyMode::Session => 1,
                    KeyMode::Messages10 => 2,
                };
                let kex = match qkd.kex {
                    QkdKex::PskKe => 1,
                    QkdKex::PskDheKe => 2,
                };
                Self { mode: Self::QKD, key_mode, kex, cipher, auth: None }
            }
        }
    }

    /// Returns the first setting in which the two differ. The most informative setting is compared first.
    ///
    /// ```
    /// use axon_daemon::internal::wire::SecurityTerms;
    ///
    /// let classic = SecurityTerms { mode: 0, key_mode: 0, kex: 0, cipher: 0, auth: Some(1) };
    /// let qkd = SecurityTerms { mode: 1, key_mode: 2, kex: 1, cipher: 0, auth: None };
    /// assert_eq!(classic.first_difference(&classic), None);
    ///
    /// let difference = classic.first_difference(&qkd).unwrap();
    /// assert_eq!(difference.setting, "AXON_SECURITY_MODE");
    /// assert_eq!((&*difference.ours, &*difference.theirs), ("classic", "qkd"));
    /// ```
    pub fn first_difference(&self, theirs: &Self) -> Option<Difference> {
        let settings = [
            ("AXON_SECURITY_MODE", Some(self.mode), Some(theirs.mode), MODES),
            ("AXON_QKD_KEY_MODE", Some(self.key_mode), Some(theirs.key_mode), KEY_MODES),
            ("AXON_QKD_KEX", Some(self.kex), Some(theirs.kex), KEXES),
            ("AXON_QUIC_CIPHER", Some(self.cipher), Some(theirs.cipher), CIPHERS),
            ("AXON_CLASSIC_AUTH", self.auth, theirs.auth, AUTHS),
        ];
        let (setting, ours, theirs, names) =
            settings.into_iter().find(|(_, ours, theirs, _)| ours != theirs)?;
        let word = |code: Option<u8>| match code {
            None => "absent".to_owned(),
            Some(code) => match names.get(usize::from(code)) {
                Some(name) => (*name).to_owned(),
                None => format!("unknown to this version (code {code})"),
            },
        };
        Some(Difference { setting, ours: word(ours), theirs: word(theirs) })
    }
}
