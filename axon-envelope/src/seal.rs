//! Sealing: one key, at most ten messages.

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

/// How long after its first message a key may seal.
pub const KEY_MAX_AGE: Duration = Duration::from_secs(3600);

/// Longest plaintext AES-GCM allows, in bytes (NIST SP 800-38D, 5.2.1.1).
pub const MAX_PLAINTEXT_LEN: u64 = (1 << 36) - 32;

/// Seals up to ten messages under one key.
///
/// Each message takes a [`Slot`], and a slot seals one message: the compiler refuses a second.
///
/// ```compile_fail,E0382
/// # use axon_envelope::*;
/// # fn f(slot: Slot<'_>, route: Route, out: &mut [u8]) {
/// slot.seal_into(route, &[b"one"], out).unwrap();
/// slot.seal_into(route, &[b"two"], out).unwrap(); // use of moved value
/// # }
/// ```
///
/// Two slots cannot exist at once, and a retired sealer is gone:
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
/// It cannot be copied, or two would count from zero under one key:
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
    /// Kept until the first message, for a caller that moves the key to another connection.
    key: Option<KmeKey>,
    /// The lowest index that was never handed to the AEAD.
    next: u8,
    used: IndexMask,
    reliable: IndexMask,
    first_used: Option<Duration>,
    /// The latest time a slot was asked for.
    latest: Duration,
}

/// Why a sealer seals no more.
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

/// What became of a sealer's key: the content of RETIRE.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Retirement {
    /// The key.
    pub key_id: KeyId,
    /// Indexes under which a message was sealed.
    pub used: IndexMask,
    /// Those of them sealed as [`Delivery::Reliable`].
    pub reliable: IndexMask,
}

/// Why a message was not sealed. Its index stays free, except after [`SealError::Aead`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SealError {
    /// The caller's buffer has not the size needed.
    #[error("a buffer of {given} bytes where {needed} are needed")]
    Buffer {
        /// Bytes needed.
        needed: usize,
        /// Bytes given.
        given: usize,
    },
    /// More plaintext than [`MAX_PLAINTEXT_LEN`].
    #[error("{0} bytes are more than AES-GCM seals under one nonce")]
    TooLong(usize),
    /// The AEAD failed; the index is used up, and the buffer holds nothing of use.
    #[error("the AEAD failed")]
    Aead,
}

impl Sealer {
    /// A sealer for a key nothing was sealed under before, with the default AEAD.
    ///
    /// # Errors
    /// [`RandomError`] if the system gives no random bytes for the nonce.
    pub fn new(channel: &Channel, key_id: KeyId, key: KmeKey) -> Result<Self, RandomError> {
        Self::with_aead(channel, key_id, key)
    }
}

impl<A: Aead> Sealer<A> {
    /// As [`Sealer::new`], with an AEAD of choice: `Sealer::<RustCrypto>::with_aead(…)`.
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
    /// Nonces differ by their index whatever the prefix is. The prefix is the second line: it
    /// keeps them apart when one key is, against all rules, given to two sealers.
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

    /// The key's name.
    pub fn key_id(&self) -> &KeyId {
        &self.0.key_id
    }

    /// Bytes in front of the ciphertext, the same for every message of this sealer.
    pub fn header_len(&self) -> usize {
        self.0.template.len()
    }

    /// Bytes an envelope has more than its plaintext.
    pub fn overhead(&self) -> usize {
        self.header_len() + TAG_LEN
    }

    /// Messages left, by count alone.
    pub fn remaining(&self) -> u8 {
        MESSAGES_PER_KEY - self.0.next
    }

    /// Indexes a message was sealed under.
    pub fn mask_used(&self) -> IndexMask {
        self.0.used
    }

    /// Indexes a message was sealed under as [`Delivery::Reliable`].
    pub fn mask_reliable(&self) -> IndexMask {
        self.0.reliable
    }

    /// Why no further message can be sealed at `now`, if so.
    ///
    /// `now` is monotonic time since an instant of the caller's choice, here as everywhere. If it
    /// goes backwards, it counts as standing still.
    pub fn spent(&self, now: Duration) -> Option<Spent> {
        if self.remaining() == 0 {
            return Some(Spent::Messages);
        }
        let age = now.max(self.0.latest).saturating_sub(self.0.first_used?);
        (age >= KEY_MAX_AGE).then_some(Spent::Age)
    }

    /// A permit for one message. Dropping it unused uses nothing up.
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

    /// Ends the sealer, erases its key, and says what to tell the receiver.
    pub fn retire(self) -> Retirement {
        let SealState { key_id, used, reliable, .. } = *self.0;
        Retirement { key_id, used, reliable }
    }

    /// Gives the key back if it has sealed nothing, so that another connection can use it.
    ///
    /// # Errors
    /// The sealer itself, once it has sealed anything.
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

/// A permit to seal one message under one index. Every way of sealing consumes it, and it cannot be
/// copied:
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
    /// The index the message will have.
    pub fn index(&self) -> u8 {
        self.state.next
    }

    /// Bytes in front of the ciphertext, as [`Sealer::header_len`]: with another key it can differ.
    pub fn header_len(&self) -> usize {
        self.state.template.len()
    }

    /// Bytes the envelope will have more than its plaintext.
    pub fn overhead(&self) -> usize {
        self.header_len() + TAG_LEN
    }

    /// Seals a message where it lies: `frame` is `header_len` bytes of room, the plaintext, and
    /// [`TAG_LEN`] bytes of room, and becomes the envelope.
    ///
    /// # Errors
    /// [`SealError::Buffer`] if there is no room for header and tag, [`SealError::TooLong`].
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

    /// Seals the concatenation of `parts` into the front of `out`; returns the envelope's length.
    ///
    /// One part is encrypted from where it is into `out`; several are copied there first.
    ///
    /// # Errors
    /// [`SealError::Buffer`] if `out` is shorter than the envelope, [`SealError::TooLong`].
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

    /// Seals with header, body and tag apart: writes the header, encrypts `in_out` where it lies,
    /// returns the tag. The envelope is the three in this order.
    ///
    /// # Errors
    /// [`SealError::Buffer`] unless `header` has exactly `header_len` bytes,
    /// [`SealError::TooLong`].
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

        // The index is gone before the AEAD sees it: even if the AEAD panics, no second message
        // gets its nonce. `slot` handed this permit out only with an index below ten left.
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
