//! Key bytes as they come from the KME, and what is derived from them.

use alloc::boxed::Box;
use core::hint::black_box;
use core::panic::{RefUnwindSafe, UnwindSafe};

use hkdf::Hkdf;
use secrecy::{ExposeSecret, ExposeSecretMut, SecretBox};
use sha2::Sha256;
use zeroize::{Zeroize, Zeroizing};

use crate::aead::Aead;
use crate::channel::{Channel, KeyId};
use crate::erase::erasing_stack;

/// A 256-bit key as a KME delivered it, erased on drop.
///
/// Its bytes come out only through [`ExposeSecret`] and [`derive`](Self::derive):
///
/// ```
/// use axon_envelope::{KmeKey, secrecy::ExposeSecret};
///
/// let key = KmeKey::take(&mut [1; 32]);
/// assert_eq!(key.expose_secret(), &[1; 32]);
/// ```
///
/// It can be neither cloned nor printed:
///
/// ```compile_fail,E0599
/// # use axon_envelope::KmeKey;
/// let key = KmeKey::take(&mut [1; 32]);
/// let copy: KmeKey = key.clone();
/// ```
/// ```compile_fail,E0277
/// # use axon_envelope::KmeKey;
/// let key = KmeKey::take(&mut [1; 32]);
/// println!("{key:?}");
/// ```
// Boxed, so that moving the key copies a pointer and leaves no key bytes behind.
pub struct KmeKey(Box<Holder>);

/// What holds the bytes, and erases them on drop.
type Holder = dyn ExposeSecret<[u8; 32]> + Send + Sync + UnwindSafe + RefUnwindSafe;

/// Key bytes of a length other than 32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the key has {0} bytes; AXQKD001 takes exactly 32: ask the KME for keys of size 256")]
pub struct KeyLength(pub usize);

/// The operating system gave no random bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the system's random number generator failed: {0}")]
pub struct RandomError(#[from] getrandom::Error);

impl KmeKey {
    /// Takes the key over and erases the place it came from.
    pub fn take(bytes: &mut [u8; 32]) -> Self {
        let key = Self::copy(bytes);
        bytes.zeroize();
        key
    }

    /// Copies a key; erasing `bytes` stays with the caller.
    ///
    /// # Errors
    /// [`KeyLength`] unless there are exactly 32 bytes.
    pub fn from_slice(bytes: &[u8]) -> Result<Self, KeyLength> {
        bytes.try_into().map(Self::copy).map_err(|_| KeyLength(bytes.len()))
    }

    /// A key that stays where its holder has it, as in memory that is never swapped out. A
    /// `SecretBox<[u8; 32]>` of the crate `secrecy` is a holder.
    ///
    /// The holder erases it on drop, and gives the same bytes each time it is asked.
    pub fn from_holder<H>(holder: H) -> Self
    where
        H: ExposeSecret<[u8; 32]> + Send + Sync + UnwindSafe + RefUnwindSafe + 'static,
    {
        Self(Box::new(holder))
    }

    /// Runs `derivation` on the key so that nothing of it is left on the stack.
    ///
    /// Libraries for hashes, HKDF and ciphers erase their states, but not what they moved, spilled
    /// or returned by value: their stack frames keep parts of the key and of all that is made of
    /// it. So the derivation runs again, with 32 zeros for the key: the same code at the same depth
    /// writes to the same places, whichever they are, takes no more stack, and leaves registers
    /// without secrets as well. The upper part of that stack is overwritten besides.
    ///
    /// That holds if the derivation takes the same way whatever the key is, as code that runs in
    /// constant time does, and has no side effects. What it returns is moved: a secret in it has to
    /// be behind a pointer. A signal that interrupts the first run leaves registers on the stack.
    pub fn derive<T>(&self, derivation: impl Fn(&[u8; 32]) -> T) -> T {
        erasing_stack(|| {
            let derived = run(&derivation, self.expose_secret());
            // Opaque, so that this run is neither left out nor compiled in another way.
            drop(black_box(run(&derivation, black_box(&[0; 32]))));
            derived
        })
    }

    pub(crate) fn random() -> Result<Self, RandomError> {
        let mut key = Zeroizing::new([0; 32]);
        getrandom::fill(&mut key[..])?;
        Ok(Self::copy(&key))
    }

    fn copy(bytes: &[u8; 32]) -> Self {
        let mut own = SecretBox::new(Box::new([0; 32]));
        own.expose_secret_mut().copy_from_slice(bytes);
        Self::from_holder(own)
    }
}

/// The key's bytes, for a derivation of the caller's own. [`KmeKey::derive`] leaves nothing of them
/// on the stack.
impl ExposeSecret<[u8; 32]> for KmeKey {
    fn expose_secret(&self) -> &[u8; 32] {
        self.0.expose_secret()
    }
}

/// Never inlined, so that each run is the same code at the same depth.
#[inline(never)]
fn run<T>(derivation: &impl Fn(&[u8; 32]) -> T, key: &[u8; 32]) -> T {
    derivation(black_box(key))
}

/// The AEAD for one KME key in one direction of one connection.
///
/// Every field is length-prefixed, so no two different tuples share an info string.
pub(crate) fn aead<A: Aead>(channel: &Channel, key_id: &KeyId, key: &KmeKey) -> A {
    const LABEL: &[u8] = b"seal";
    let fields =
        [LABEL, key_id.as_bytes(), channel.sender(), channel.receiver(), channel.context()];
    let lengths = fields.map(|field| {
        // `KeyId` and `Channel` hold at most 65,535 bytes a field.
        (field.len() as u16).to_be_bytes()
    });
    let mut info: [&[u8]; 10] = [&[]; 10];
    for (pair, (length, field)) in info.chunks_exact_mut(2).zip(lengths.iter().zip(fields)) {
        pair[0] = length;
        pair[1] = field;
    }

    key.derive(|key| {
        let mut derived = Zeroizing::new([0; 32]);
        Hkdf::<Sha256>::new(Some(b"AXQKD001"), key)
            .expand_multi_info(&info, &mut derived[..])
            .expect("32 bytes are within HKDF-SHA256's 8,160");
        A::new(&derived)
    })
}
