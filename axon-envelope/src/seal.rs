//! Seals messages: one key for at most ten messages.

use alloc::boxed::Box;
use core::fmt;
use core::time::Duration;

use crate::TAG_LEN;
use crate::aead::{Aead, AeadError, DefaultAead};
use crate::channel::{Channel, KeyId};
use crate::header::{NONCE_LEN, Template};
use crate::key::{self, KmeKey, RandomError};
use crate::mask::{Delivery, IndexMask, MESSAGES_PER_KEY};
use crate::route::Route;

/// The time after its first message in which a key may seal.
pub const KEY_MAX_AGE: Duration = Duration::from_secs(3600);

/// The longest plaintext that AES-GCM allows, in bytes (NIST SP 800-38D, 5.2.1.1).
pub const MAX_PLAINTEXT_LEN: u64 = (1 << 36) - 32;

/// Seals up to ten messages under one key.
///
/// Each message needs a [`Slot`], and a slot seals one message. The compiler refuses a second:
///
/// ```compile_fail,E0382
/// # use axon_envelope::*;
/// # fn f(slot: Slot<'_>, route: Route, out: &mut [u8]) {
/// slot.seal_into(route, &[b"one"], out).unwrap();
/// slot.seal_into(route, &[b"two"], out).unwrap(); // use of moved value
/// # }
/// ```
///
/// Two slots cannot exist at once, and a retired sealer is consumed:
///
/// ```compile_fail,E0499
/// # use axon_envelope::*;
/// # fn f(mut sealer: Sealer, now: std::time::Duration) {
/// let a = sealer.slot(now, Delivery::Reliable).unwrap();
/// let b = sealer.slot(now, Delivery::Reliable).unwrap(); // second mutable borrow
/// # drop((a, b));
/// # }
/// ```
/// ```compile_fail,E0382
/// # use axon_envelope::*;
/// # fn f(mut sealer: Sealer, now: std::time::Duration) {
/// let told_to_the_peer = sealer.retire();
/// let slot = sealer.slot(now, Delivery::Reliable); // use of moved value
/// # }
/// ```
/// ```compile_fail,E0382
/// # use axon_envelope::*;
/// # fn f(mut sealer: Sealer, now: std::time::Duration) {
/// let key_for_another_connection = sealer.into_unused();
/// let slot = sealer.slot(now, Delivery::Reliable); // use of moved value
/// # }
/// ```
///
/// It cannot be copied, because two copies would count from zero under one key:
///
/// ```compile_fail,E0599
/// # use axon_envelope::*;
/// # fn f(sealer: Sealer) {
/// let twin: Sealer = sealer.clone();
/// # }
/// ```
pub struct Sealer<A = DefaultAead>(Box<SealState<A>>);

type Nonce = [u8; NONCE_LEN];
type Tag = [u8; TAG_LEN];

struct SealState<A> {
    aead: A,
    template: Template,
    key_id: KeyId,
    /// The key itself, kept until the first message, for a caller that moves the key to another
    /// connection.
    key: Option<KmeKey>,
    /// The lowest index that was never passed to the AEAD.
    next: u8,
    used: IndexMask,
    reliable: IndexMask,
    first_used: Option<Duration>,
    /// The latest time at which a slot was requested.
    latest: Duration,
}

/// The reason why a sealer seals no more messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Spent {
    /// It has sealed its ten messages.
    #[error("the key has sealed its ten messages: retire it and take the next")]
    Messages,
    /// It has been in use for [`KEY_MAX_AGE`].
    #[error("the key was first used an hour ago: retire it and take the next")]
    Age,
}

/// The final state of a sealer's key, which is the content of RETIRE.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Retirement {
    /// The key.
    pub key_id: KeyId,
    /// The indexes under which a message was sealed.
    pub used: IndexMask,
    /// The indexes under which a message was sealed as [`Delivery::Reliable`].
    pub reliable: IndexMask,
}

/// The reason why a message was not sealed. Its index stays free, except after [`SealError::Aead`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SealError {
    /// The caller's buffer does not have the needed size.
    #[error("a buffer of {given} bytes where {needed} are needed")]
    Buffer {
        /// The number of bytes needed.
        needed: usize,
        /// The number of bytes given.
        given: usize,
    },
    /// The plaintext is longer than [`MAX_PLAINTEXT_LEN`].
    #[error("{0} bytes are more than AES-GCM seals under one nonce")]
    TooLong(usize),
    /// The AEAD failed. The index is used up, and the buffer's contents are useless.
    #[error("the AEAD failed")]
    Aead,
}

impl Sealer {
    /// Makes a sealer for a key under which nothing was sealed before, with the default AEAD.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes for the nonce.
    pub fn new(channel: &Channel, key_id: KeyId, key: KmeKey) -> Result<Self, RandomError> {
        Self::with_aead(channel, key_id, key)
    }
}

impl<A: Aead> Sealer<A> {
    /// As [`Sealer::new`], with the AEAD that the caller chooses:
    /// `Sealer::<RustCrypto>::with_aead(…)`.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes for the nonce.
    pub fn with_aead(channel: &Channel, key_id: KeyId, key: KmeKey) -> Result<Self, RandomError> {
        let mut prefix = [0; 8];
        getrandom::fill(&mut prefix)?;
        Ok(Self::with_nonce_prefix(channel, key_id, key, prefix))
    }

    /// As [`Sealer::with_aead`], with the nonce's first 8 bytes from the caller's own random
    /// source.
    ///
    /// Nonces differ by their index for any prefix. The prefix is a second protection: it makes
    /// nonces differ if one key is given to two sealers, which is forbidden.
    pub fn with_nonce_prefix(
        channel: &Channel,
        key_id: KeyId,
        key: KmeKey,
        prefix: [u8; 8],
    ) -> Self {
        Self(Box::new(SealState {
            aead: key::aead(channel, &key_id, &key),
            template: Template::new(channel.sender(), &key_id, prefix),
            key_id,
            key: Some(key),
            next: 0,
            used: IndexMask::EMPTY,
            reliable: IndexMask::EMPTY,
            first_used: None,
            latest: Duration::ZERO,
        }))
    }

    /// Returns the key_ID.
    pub fn key_id(&self) -> &KeyId {
        &self.0.key_id
    }

    /// Returns the number of bytes before the ciphertext, which is the same for every message of
    /// this sealer.
    pub fn header_len(&self) -> usize {
        self.0.template.len()
    }

    /// Returns the difference between the lengths of an envelope and its plaintext.
    pub fn overhead(&self) -> usize {
        self.header_len() + TAG_LEN
    }

    /// Returns how many messages the key can still seal. Its age is not considered.
    pub fn remaining(&self) -> u8 {
        MESSAGES_PER_KEY - self.0.next
    }

    /// Returns the indexes under which a message was sealed.
    pub fn mask_used(&self) -> IndexMask {
        self.0.used
    }

    /// Returns the indexes under which a message was sealed as [`Delivery::Reliable`].
    pub fn mask_reliable(&self) -> IndexMask {
        self.0.reliable
    }

    /// Returns why no more messages can be sealed at `now`, or `None` if they can.
    ///
    /// `now` is monotonic time since an instant that the caller chooses, in all functions of this
    /// type. If it goes backwards, the latest time is used instead.
    pub fn spent(&self, now: Duration) -> Option<Spent> {
        if self.remaining() == 0 {
            return Some(Spent::Messages);
        }
        let age = now.max(self.0.latest).saturating_sub(self.0.first_used?);
        (age >= KEY_MAX_AGE).then_some(Spent::Age)
    }

    /// Returns a permit for one message. If it is dropped unused, no index is used up.
    ///
    /// # Errors
    /// [`Spent`] after ten messages, or an hour after the first.
    pub fn slot(&mut self, now: Duration, delivery: Delivery) -> Result<Slot<'_, A>, Spent> {
        self.0.latest = self.0.latest.max(now);
        match self.spent(now) {
            Some(spent) => Err(spent),
            None => Ok(Slot { state: &mut self.0, delivery }),
        }
    }

    /// Ends the sealer and erases its key. Returns what the receiver has to be told.
    pub fn retire(self) -> Retirement {
        let SealState { key_id, used, reliable, .. } = *self.0;
        Retirement { key_id, used, reliable }
    }

    /// Returns the key if it has sealed nothing, so that another connection can use it.
    ///
    /// # Errors
    /// The sealer itself, if it has passed a message to the AEAD.
    pub fn into_unused(mut self) -> Result<(KeyId, KmeKey), Self> {
        match self.0.key.take() {
            Some(key) => Ok((self.0.key_id, key)),
            None => Err(self),
        }
    }
}

/// Shows the key_ID and the masks, never a key.
impl<A> fmt::Debug for Sealer<A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Sealer")
            .field("key_id", &self.0.key_id)
            .field("used", &self.0.used)
            .field("reliable", &self.0.reliable)
            .finish_non_exhaustive()
    }
}

/// A permit to seal one message under one index. Every method that seals consumes it, and it cannot
/// be copied:
///
/// ```compile_fail,E0599
/// # use axon_envelope::*;
/// # fn f(slot: Slot<'_>) {
/// let twin: Slot<'_> = slot.clone();
/// # }
/// ```
pub struct Slot<'a, A = DefaultAead> {
    state: &'a mut SealState<A>,
    delivery: Delivery,
}

impl<A: Aead> Slot<'_, A> {
    /// Returns the index that the message will have.
    pub fn index(&self) -> u8 {
        self.state.next
    }

    /// Returns the number of bytes before the ciphertext, as [`Sealer::header_len`] does. It can
    /// differ for another key.
    pub fn header_len(&self) -> usize {
        self.state.template.len()
    }

    /// Returns the difference between the lengths of the envelope and its plaintext.
    pub fn overhead(&self) -> usize {
        self.header_len() + TAG_LEN
    }

    /// Seals a message in place. `frame` consists of `header_len` bytes for the header, the
    /// plaintext, and [`TAG_LEN`] bytes for the tag. It becomes the envelope.
    ///
    /// # Errors
    /// [`SealError::Buffer`] if there is no space for header and tag, [`SealError::TooLong`], or
    /// [`SealError::Aead`].
    pub fn seal_in_place(self, route: Route, frame: &mut [u8]) -> Result<(), SealError> {
        let header_len = self.state.template.len();
        let needed = header_len + TAG_LEN;
        if frame.len() < needed {
            return Err(SealError::Buffer { needed, given: frame.len() });
        }
        let (header, rest) = frame.split_at_mut(header_len);
        let (body, tag) = rest.split_at_mut(rest.len() - TAG_LEN);
        tag.copy_from_slice(&self.seal_detached(route, header, body)?);
        Ok(())
    }

    /// Seals the concatenation of `parts` into the front of `out`. Returns the envelope's length.
    ///
    /// A single part is encrypted directly into `out`. Several parts are copied there first.
    ///
    /// # Errors
    /// [`SealError::Buffer`] if `out` is shorter than the envelope, [`SealError::TooLong`], or
    /// [`SealError::Aead`].
    pub fn seal_into(
        self,
        route: Route,
        parts: &[&[u8]],
        out: &mut [u8],
    ) -> Result<usize, SealError> {
        let header_len = self.state.template.len();
        let body_len = parts.iter().fold(0_usize, |sum, part| sum.saturating_add(part.len()));
        let needed = body_len.saturating_add(header_len + TAG_LEN);
        let given = out.len();
        let envelope = out.get_mut(..needed).ok_or(SealError::Buffer { needed, given })?;

        if let [plaintext] = parts {
            let (header, rest) = envelope.split_at_mut(header_len);
            let (body, tag) = rest.split_at_mut(body_len);
            let sealed = self.seal_with(route, header, body_len, |aead, nonce, aad| {
                aead.seal_apart(nonce, aad, plaintext, body)
            })?;
            tag.copy_from_slice(&sealed);
        } else {
            let mut at = header_len;
            for part in parts {
                envelope[at..at + part.len()].copy_from_slice(part);
                at += part.len();
            }
            self.seal_in_place(route, envelope)?;
        }
        Ok(needed)
    }

    /// Seals with separate header, body and tag. Writes the header, encrypts `in_out` in place, and
    /// returns the tag. The envelope is the three in this order.
    ///
    /// # Errors
    /// [`SealError::Buffer`] unless `header` has exactly `header_len` bytes,
    /// [`SealError::TooLong`], or [`SealError::Aead`].
    pub fn seal_detached(
        self,
        route: Route,
        header: &mut [u8],
        in_out: &mut [u8],
    ) -> Result<[u8; TAG_LEN], SealError> {
        self.seal_with(route, header, in_out.len(), |aead, nonce, aad| {
            aead.seal_in_place(nonce, aad, in_out)
        })
    }

    fn seal_with(
        self,
        route: Route,
        header: &mut [u8],
        body_len: usize,
        seal: impl FnOnce(&A, &Nonce, &[u8]) -> Result<Tag, AeadError>,
    ) -> Result<[u8; TAG_LEN], SealError> {
        let state = self.state;
        let needed = state.template.len();
        if header.len() != needed {
            return Err(SealError::Buffer { needed, given: header.len() });
        }
        if body_len as u64 > MAX_PLAINTEXT_LEN {
            return Err(SealError::TooLong(body_len));
        }

        // The index is used up before the AEAD runs: even if the AEAD panics, no second message
        // gets its nonce. `slot` returned this permit only because fewer than ten indexes were
        // used.
        let index = state.next;
        state.next += 1;
        state.key = None;
        state.first_used.get_or_insert(state.latest);

        let nonce = state.template.write(route, index, header);
        let tag = seal(&state.aead, &nonce, header).map_err(|_| SealError::Aead)?;
        state.used.insert(index);
        if self.delivery == Delivery::Reliable {
            state.reliable.insert(index);
        }
        Ok(tag)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Opener;
    use alloc::format;

    #[test]
    fn printing_a_sealer_or_an_opener_shows_names_and_counts_alone() {
        let channel = Channel::new("alice", "bob", b"exporter").unwrap();
        let id = KeyId::new("id").unwrap();
        let key = || KmeKey::take(&mut [0x6b; 32]);
        let sealer = Sealer::new(&channel, id.clone(), key()).unwrap();
        assert_eq!(
            format!("{sealer:?}"),
            "Sealer { key_id: KeyId(id), used: IndexMask(0b0000000000), \
             reliable: IndexMask(0b0000000000), .. }"
        );
        let mut opener = Opener::new(channel).unwrap();
        opener.add_key(id, key()).unwrap();
        assert_eq!(
            format!("{opener:?}"),
            "Opener { channel: Channel { sender: alice, receiver: bob, .. }, keys: 1, .. }"
        );
    }
}
