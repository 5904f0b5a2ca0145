//! Opens envelopes: finds keys by key_ID, opens each index once, and gives one refusal for all
//! cryptographic failures.

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

/// Opens envelopes that the other end of one [`Channel`] has sealed.
///
/// A connection has one opener for its incoming direction. `now` is monotonic time since an instant
/// that the caller chooses, the same for all calls. If time goes backwards, the latest time is used
/// instead.
///
/// A key that is held, or that is retired, is refused when it is added again.
/// [`Limits::retired_memory`] bounds how many retired key_IDs are remembered. Beyond it, two other
/// properties ensure that a key is used once: the KME delivers each key_ID once, and the channel's
/// context is new with every connection.
///
/// It cannot be copied, because each copy would open every message once:
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
    /// The latest time that a caller has given.
    latest: Duration,
}

/// Limits on the keys that an [`Opener`] holds, and on their times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// The most keys held. The default is 4,096.
    pub max_keys: usize,
    /// The time after RETIRE in which a best-effort message can still open. The default is 5 s.
    pub best_effort_grace: Duration,
    /// The time after its first message in which a key opens messages without RETIRE, and the time
    /// after RETIRE in which a reliable message can still open. The default is [`KEY_MAX_AGE`] and
    /// one minute for messages in transit.
    pub max_age: Duration,
    /// The number of retired key_IDs remembered. The default is 16,384. Each takes at most about
    /// 100 bytes and the ID.
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

/// The reason why a key was not added.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AddKeyError {
    /// [`Limits::max_keys`] keys are held.
    #[error("{0} keys are held and none is retired: the sender must retire keys first")]
    Full(usize),
    /// A key with this key_ID is held.
    #[error("a key with this key_ID is held already: the KME delivered a key_ID twice")]
    Held,
    /// A key with this key_ID was held and is retired.
    #[error("the key with this key_ID is retired: the KME delivered a key_ID twice")]
    Retired,
}

/// The result of a RETIRE.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum RetireOutcome {
    /// All messages had opened, or none was to be waited for. The key is erased.
    Erased,
    /// These indexes can still open.
    Waiting(IndexMask),
    /// The key is not held. This is usual after all ten messages have opened.
    NotHeld,
}

/// A RETIRE that contradicts itself or the opened messages. The key is unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RetireError {
    /// An index is reliable but not used.
    #[error("reliable indexes {reliable:?} are not among the used {used:?}")]
    Masks {
        /// The mask of used indexes.
        used: IndexMask,
        /// The mask of reliable indexes.
        reliable: IndexMask,
    },
    /// A message has opened whose index RETIRE reports as unused.
    #[error("indexes {opened:?} have opened, but only {used:?} are called used")]
    OpenedUnused {
        /// The mask of used indexes.
        used: IndexMask,
        /// The indexes that have opened.
        opened: IndexMask,
    },
}

/// The number of keys that [`Opener::expire`] erased, and of messages that never came.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Expired {
    /// The number of keys that this call erased.
    pub keys: usize,
    /// The number of messages that RETIRE reported as used and that never came, under all keys that
    /// were retired since the last call for any reason.
    pub messages_missing: usize,
}

impl Opener {
    /// Makes an opener without keys, with the default AEAD and limits.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes.
    pub fn new(channel: Channel) -> Result<Self, RandomError> {
        Self::with_limits(channel, Limits::default())
    }
}

impl<A: Aead> Opener<A> {
    /// As [`Opener::new`], with the AEAD and limits that the caller chooses.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes.
    pub fn with_limits(channel: Channel, limits: Limits) -> Result<Self, RandomError> {
        // An envelope that is refused for another reason than its tag is opened with a random key
        // that nobody knows, so that the refusal costs as much as a wrong tag.
        let decoy = KmeKey::random()?.derive(A::new);
        Ok(Self { channel, keys: Keyring::new(limits), decoy, latest: Duration::ZERO })
    }

    /// Adds a key that the sender has announced.
    ///
    /// # Errors
    /// [`AddKeyError`] if the limit is reached or the key_ID is known already. The key is erased.
    pub fn add_key(&mut self, key_id: KeyId, key: KmeKey) -> Result<(), AddKeyError> {
        let aead = key::aead(&self.channel, &key_id, &key);
        self.keys.add(key_id, key, aead)
    }

    /// Opens an envelope in place. Returns the plaintext within it.
    ///
    /// `route` is the route that the caller expects from the stream or frame in which the message
    /// came. A caller without an expectation parses the envelope first and passes the header's
    /// route.
    ///
    /// # Errors
    /// [`OpenError::Header`] before any key is used, with `envelope` unchanged;
    /// [`OpenError::Refused`] for all other failures, with the body of `envelope` erased.
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

    /// Opens an envelope into the front of `out`. Returns the plaintext's length.
    ///
    /// # Errors
    /// [`OpenError::Header`] and [`OpenError::BufferTooSmall`] before any key is used, with `out`
    /// unchanged; [`OpenError::Refused`] for all other failures, with the part of `out` erased that
    /// the plaintext would fill.
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

    /// Opens an envelope given in its three parts. Decrypts `in_out` in place.
    ///
    /// # Errors
    /// The same as for [`Opener::open_in_place`]; also [`HeaderError::Trailing`] if `header` has
    /// bytes after the header.
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

    /// Handles a RETIRE: the sender seals no more messages under `key_id`.
    ///
    /// The key is kept until each index in `reliable` has opened, but no longer than
    /// [`Limits::max_age`]. The other indexes of `used` can still open for
    /// [`Limits::best_effort_grace`].
    ///
    /// # Errors
    /// [`RetireError`] if the masks contradict each other or the opened messages. The peer is then
    /// defective or lying, and its connection should be closed.
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

    /// Erases the keys whose time is over. Call it about once a second. It only affects how long a
    /// dead key stays in memory, not which messages open.
    pub fn expire(&mut self, now: Duration) -> Expired {
        let now = self.advance(now);
        self.keys.expire(now)
    }

    /// Removes and returns a key under which nothing has opened, so that it can be announced on a
    /// new connection.
    pub fn take_unused(&mut self, key_id: &[u8]) -> Option<(KeyId, KmeKey)> {
        self.keys.take_unused(key_id)
    }

    /// Returns the keys under which nothing has opened and for which no RETIRE came.
    pub fn unused_keys(&self) -> impl Iterator<Item = &KeyId> {
        self.keys.unused()
    }

    /// Returns whether a key is held that is not retired.
    pub fn contains(&self, key_id: &[u8]) -> bool {
        self.keys.contains(key_id)
    }

    /// Returns the number of keys held.
    pub fn key_count(&self) -> usize {
        self.keys.len()
    }

    /// Returns the limits of this opener.
    pub fn limits(&self) -> &Limits {
        self.keys.limits()
    }

    /// Returns the latest time so far. Time must not go backwards, because retired keys would
    /// become valid again.
    fn advance(&mut self, now: Duration) -> Duration {
        self.latest = self.latest.max(now);
        self.latest
    }

    /// Opens any envelope with a well-formed header. It makes one look-up and one pass of the AEAD
    /// over the whole body, and on failure erases the output once, whatever the cause.
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

/// Returns the range of the ciphertext in an envelope.
fn body_range(envelope: &[u8]) -> Result<core::ops::Range<usize>, HeaderError> {
    let (_, start) = Header::parse(envelope)?;
    match envelope.len().checked_sub(TAG_LEN) {
        Some(end) if end >= start => Ok(start..end),
        _ => Err(HeaderError::Truncated { needed: start + TAG_LEN, given: envelope.len() }),
    }
}

/// Shows the channel's SAE IDs and the number of keys, never a key.
impl<A: Aead> fmt::Debug for Opener<A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Opener")
            .field("channel", &self.channel)
            .field("keys", &self.keys.len())
            .finish_non_exhaustive()
    }
}
