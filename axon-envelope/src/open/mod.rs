//! Opening: keys by key_ID, each index once, and one refusal for every cryptographic failure.

mod error;
mod keyring;

use core::fmt;
use core::time::Duration;

pub use error::{OpenError, Refusal, RefusalCause};
use keyring::Keyring;

use crate::TAG_LEN;
use crate::aead::DefaultAead;
use crate::aead::{Aead, AeadError};
use crate::channel::{Channel, KeyId};
use crate::header::{Header, HeaderError, NONCE_LEN};
use crate::key::{self, KmeKey, RandomError};
use crate::mask::IndexMask;
use crate::route::Route;
use crate::seal::KEY_MAX_AGE;

/// Opens what the other end of one [`Channel`] has sealed.
///
/// A connection has one for its incoming direction. `now` is monotonic time since an instant of
/// the caller's choice, the same for all calls; time that goes backwards counts as standing still.
///
/// A retired key is refused when it is added again, and so is one that is held. The memory of
/// retired key_IDs is bounded by [`Limits::retired_memory`]; beyond it, that a key comes once
/// rests on the KME, which delivers each key_ID once, and on the channel's context, which is new
/// with every connection.
///
/// It cannot be copied, or each copy would open every message once:
///
/// ```compile_fail,E0599
/// # use axon_envelope::*;
/// # fn f(opener: Opener) {
/// let twin: Opener = opener.clone();
/// # }
/// ```
pub struct Opener<A = DefaultAead> {
    channel: Channel,
    keys: Keyring<A>,
    decoy: A,
    /// The latest time a caller has told.
    latest: Duration,
}

/// How much an [`Opener`] keeps, and how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// Keys held at most; default 4,096.
    pub max_keys: usize,
    /// How long after RETIRE a best-effort message can still open; default 5 s.
    pub best_effort_grace: Duration,
    /// How long after its first message a key opens without RETIRE, and how long after RETIRE a
    /// reliable message can still open; default [`KEY_MAX_AGE`] and a minute for what is on its
    /// way.
    pub max_age: Duration,
    /// Retired key_IDs remembered; default 16,384, at most some 100 bytes and the ID each.
    pub retired_memory: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_keys: 4096,
            best_effort_grace: Duration::from_secs(5),
            max_age: KEY_MAX_AGE + Duration::from_secs(60),
            retired_memory: 16_384,
        }
    }
}

/// Why a key was not added.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AddKeyError {
    /// [`Limits::max_keys`] are held.
    #[error("{0} keys are held and none is retired: the sender must retire keys first")]
    Full(usize),
    /// A key with this key_ID is held.
    #[error("a key with this key_ID is held already: the KME delivered a key_ID twice")]
    Held,
    /// A key with this key_ID was held and is retired.
    #[error("the key with this key_ID is retired: the KME delivered a key_ID twice")]
    Retired,
}

/// What RETIRE led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum RetireOutcome {
    /// Everything had opened, or nothing was to be waited for: the key is erased.
    Erased,
    /// These indexes can still open.
    Waiting(IndexMask),
    /// No such key is held; usual after all ten messages have opened.
    NotHeld,
}

/// A RETIRE that contradicts itself or what has opened. The key stays as it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RetireError {
    /// An index is called reliable and not used.
    #[error("reliable indexes {reliable:?} are not among the used {used:?}")]
    Masks {
        /// Mask of used indexes.
        used: IndexMask,
        /// Mask of reliable ones.
        reliable: IndexMask,
    },
    /// An index is called unused whose message has opened.
    #[error("indexes {opened:?} have opened, but only {used:?} are called used")]
    OpenedUnused {
        /// Mask of used indexes.
        used: IndexMask,
        /// Indexes that have opened.
        opened: IndexMask,
    },
}

/// What [`Opener::expire`] erased, and what never came.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Expired {
    /// Keys this call erased.
    pub keys: usize,
    /// Messages that RETIRE called used and that never came, under all keys that went since the
    /// last call, whatever ended them.
    pub messages_missing: usize,
}

impl Opener {
    /// An opener without keys, with the default AEAD and limits.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes.
    pub fn new(channel: Channel) -> Result<Self, RandomError> {
        Self::with_limits(channel, Limits::default())
    }
}

impl<A: Aead> Opener<A> {
    /// As [`Opener::new`], with an AEAD and limits of choice.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes.
    pub fn with_limits(channel: Channel, limits: Limits) -> Result<Self, RandomError> {
        // Envelopes that are refused before the tag counts are run against a key that nobody
        // knows, so that they cost what a wrong tag costs.
        let decoy = KmeKey::random()?.derive(A::new);
        Ok(Self { channel, keys: Keyring::new(limits), decoy, latest: Duration::ZERO })
    }

    /// Adds a key that the sender has announced.
    ///
    /// # Errors
    /// [`AddKeyError`] if the limit is reached or the key_ID was here before; the key is erased.
    pub fn add_key(&mut self, key_id: KeyId, key: KmeKey) -> Result<(), AddKeyError> {
        let aead = key::aead(&self.channel, &key_id, &key);
        self.keys.add(key_id, key, aead)
    }

    /// Opens an envelope where it lies; returns the plaintext within it.
    ///
    /// `route` is where the caller expects the message to belong, by the stream or frame it came
    /// in. A caller that goes by the envelope alone parses it first and passes the header's route.
    ///
    /// # Errors
    /// [`OpenError::Header`] before any key is looked at, with `envelope` unchanged;
    /// [`OpenError::Refused`] for everything else, with the body of `envelope` erased.
    pub fn open_in_place<'e>(
        &mut self,
        now: Duration,
        route: Route,
        envelope: &'e mut [u8],
    ) -> Result<&'e mut [u8], OpenError> {
        let body = body_range(envelope)?;
        let (header, rest) = envelope.split_at_mut(body.start);
        let (in_out, tag) = rest.split_at_mut(body.end - body.start);
        let tag = *tag.first_chunk().expect("`body_range` leaves the tag behind the body");
        self.open_detached(now, route, header, in_out, &tag)?;
        Ok(in_out)
    }

    /// Opens an envelope into the front of `out`; returns the plaintext's length.
    ///
    /// # Errors
    /// [`OpenError::Header`] and [`OpenError::BufferTooSmall`] before any key is looked at, with
    /// `out` unchanged; [`OpenError::Refused`] for everything else, with the part of `out` that
    /// the plaintext would fill erased.
    pub fn open_into(
        &mut self,
        now: Duration,
        route: Route,
        envelope: &[u8],
        out: &mut [u8],
    ) -> Result<usize, OpenError> {
        let body = body_range(envelope)?;
        let (needed, given) = (body.len(), out.len());
        let out = out.get_mut(..needed).ok_or(OpenError::BufferTooSmall { needed, given })?;
        let (header, ciphertext) = (&envelope[..body.start], &envelope[body.clone()]);
        let tag = envelope.last_chunk().expect("`body_range` leaves the tag behind the body");
        self.open_with(now, route, header, out, |aead, nonce, aad, out| {
            aead.open_apart(nonce, aad, ciphertext, tag, out)
        })?;
        Ok(needed)
    }

    /// Opens an envelope given in its three parts, decrypting `in_out` where it lies.
    ///
    /// # Errors
    /// As [`Opener::open_in_place`]; also [`HeaderError::Trailing`] if `header` is longer than the
    /// header in it.
    pub fn open_detached(
        &mut self,
        now: Duration,
        route: Route,
        header: &[u8],
        in_out: &mut [u8],
        tag: &[u8; TAG_LEN],
    ) -> Result<(), OpenError> {
        self.open_with(now, route, header, in_out, |aead, nonce, aad, in_out| {
            aead.open_in_place(nonce, aad, in_out, tag)
        })
    }

    /// Notes a RETIRE: the sender seals no more under `key_id`.
    ///
    /// The key is kept until each index in `reliable` has opened, but no longer than
    /// [`Limits::max_age`]; the others of `used` can still open for [`Limits::best_effort_grace`].
    ///
    /// # Errors
    /// [`RetireError`] if the masks contradict each other or what has opened: the peer is broken
    /// or lying, and its connection should be closed.
    pub fn retire(
        &mut self,
        now: Duration,
        key_id: &[u8],
        used: IndexMask,
        reliable: IndexMask,
    ) -> Result<RetireOutcome, RetireError> {
        let now = self.advance(now);
        self.keys.retire(now, key_id, used, reliable)
    }

    /// Erases the keys whose time is over. To be called about once a second; which messages open
    /// does not depend on it, only how long a dead key stays in memory.
    pub fn expire(&mut self, now: Duration) -> Expired {
        let now = self.advance(now);
        self.keys.expire(now)
    }

    /// Takes a key out under which nothing has opened, to announce it on a new connection.
    pub fn take_unused(&mut self, key_id: &[u8]) -> Option<(KeyId, KmeKey)> {
        self.keys.take_unused(key_id)
    }

    /// The keys under which nothing has opened and that are not being retired.
    pub fn unused_keys(&self) -> impl Iterator<Item = &KeyId> {
        self.keys.unused()
    }

    /// Whether a key can still open something.
    pub fn contains(&self, key_id: &[u8]) -> bool {
        self.keys.contains(key_id)
    }

    /// Keys held.
    pub fn key_count(&self) -> usize {
        self.keys.len()
    }

    /// The limits it was made with.
    pub fn limits(&self) -> &Limits {
        self.keys.limits()
    }

    /// Time never goes backwards, or what has been retired would live again.
    fn advance(&mut self, now: Duration) -> Duration {
        self.latest = self.latest.max(now);
        self.latest
    }

    /// Every envelope with a well-formed header goes this way: one look-up, one pass of the AEAD
    /// over all of it, and on failure one erasure, whatever the cause.
    fn open_with(
        &mut self,
        now: Duration,
        route: Route,
        header: &[u8],
        out: &mut [u8],
        open: impl FnOnce(&A, &[u8; NONCE_LEN], &[u8], &mut [u8]) -> Result<(), AeadError>,
    ) -> Result<(), OpenError> {
        let (parsed, header_len) = Header::parse(header)?;
        if header_len != header.len() {
            return Err(HeaderError::Trailing(header.len() - header_len).into());
        }

        let now = self.advance(now);
        let held = self.keys.select(parsed.key_id, parsed.index, now);
        let admitted = if parsed.sender != self.channel.sender() {
            Err(RefusalCause::WrongSender)
        } else if parsed.route != route {
            Err(RefusalCause::WrongRoute)
        } else if parsed.index >= crate::mask::MESSAGES_PER_KEY {
            Err(RefusalCause::IndexOutOfRange)
        } else {
            held
        };
        let (aead, refused) = match admitted {
            Ok(live) => (&live.aead, None),
            Err(cause) => (&self.decoy, Some(cause)),
        };
        let result = open(aead, &parsed.nonce, header, out);

        let cause = match (result, refused) {
            (Ok(()), None) => {
                self.keys.opened(parsed.key_id, parsed.index, now);
                return Ok(());
            }
            (_, Some(cause)) => cause,
            (Err(AeadError), None) => RefusalCause::Unauthentic,
        };
        out.fill(0);
        Err(OpenError::Refused(Refusal(cause)))
    }
}

/// Where the ciphertext of an envelope lies.
fn body_range(envelope: &[u8]) -> Result<core::ops::Range<usize>, HeaderError> {
    let (_, start) = Header::parse(envelope)?;
    match envelope.len().checked_sub(TAG_LEN) {
        Some(end) if end >= start => Ok(start..end),
        _ => Err(HeaderError::Truncated { needed: start + TAG_LEN, given: envelope.len() }),
    }
}

/// Shows the channel's SAE IDs and how many keys are held, never a key.
impl<A: Aead> fmt::Debug for Opener<A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Opener")
            .field("channel", &self.channel)
            .field("keys", &self.keys.len())
            .finish_non_exhaustive()
    }
}
