//! Identifiers: daemons, sessions and the GIDs of endpoints.

use std::fmt;

use minicbor::bytes::{ByteArray, DecodeBytes, EncodeBytes};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
        pub struct $name(pub [u8; 16]);

        impl $name {
            /// A fresh random value.
            pub fn random() -> Self {
                Self(rand::random())
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{}({self})", stringify!($name))
            }
        }

        impl<C> minicbor::Encode<C> for $name {
            fn encode<W: minicbor::encode::Write>(
                &self,
                e: &mut minicbor::Encoder<W>,
                ctx: &mut C,
            ) -> Result<(), minicbor::encode::Error<W::Error>> {
                ByteArray::from(self.0).encode_bytes(e, ctx)
            }
        }

        impl<'b, C> minicbor::Decode<'b, C> for $name {
            fn decode(
                d: &mut minicbor::Decoder<'b>,
                ctx: &mut C,
            ) -> Result<Self, minicbor::decode::Error> {
                ByteArray::<16>::decode_bytes(d, ctx).map(|b| Self(b.into()))
            }
        }

        impl serde::Serialize for $name {
            fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
                s.collect_str(self)
            }
        }
    };
}

id! {
    /// The id of a daemon: random, new at each start. A daemon is identified by it, never by an
    /// address.
    DaemonId
}
id! {
    /// The id of a process's session with its daemon: random, new for each session.
    SessionId
}
id! {
    /// The id of an endpoint: the first 12 bytes of its session's id, then its number in that
    /// session.
    Gid
}

impl Gid {
    /// Returns the GID of entity `number` of `session`.
    #[inline]
    pub fn new(session: SessionId, number: u32) -> Self {
        let mut gid = session.0;
        gid[12..].copy_from_slice(&number.to_be_bytes());
        Self(gid)
    }

    /// Returns whether this endpoint and `other` belong to the same session.
    #[inline]
    pub fn is_of_session_of(&self, other: &Self) -> bool {
        self.0[..12] == other.0[..12]
    }

    /// Returns whether `session` may give this GID to one of its endpoints.
    #[inline]
    pub fn is_of(&self, session: &SessionId) -> bool {
        self.0[..12] == session.0[..12]
    }
}
