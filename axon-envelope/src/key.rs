//! Keys as the KME delivers them, and the derivation of the AEAD's keys.

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
/// Its bytes are accessible only through [`ExposeSecret`] and [`derive`](Self::derive):
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
// The box makes a move of the key copy a pointer, so that a move leaves no key bytes behind.
pub struct KmeKey(Box<Holder>);

/// The owner of the bytes, which erases them on drop.
type Holder = dyn ExposeSecret<[u8; 32]> + Send + Sync + UnwindSafe + RefUnwindSafe;

/// The error for key bytes of a length other than 32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the key has {0} bytes; AXQKD001 takes exactly 32: ask the KME for keys of size 256")]
pub struct KeyLength(pub usize);

/// The error if the operating system gave no random bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the system's random number generator failed: {0}")]
pub struct RandomError(#[from] getrandom::Error);

impl KmeKey {
    /// Takes the key over, and erases `bytes`.
    pub fn take(bytes: &mut [u8; 32]) -> Self {
        let key = Self::copy(bytes);
        bytes.zeroize();
        key
    }

    /// Copies a key. The caller has to erase `bytes`.
    ///
    /// # Errors
    /// [`KeyLength`] unless there are exactly 32 bytes.
    pub fn from_slice(bytes: &[u8]) -> Result<Self, KeyLength> {
        bytes.try_into().map(Self::copy).map_err(|_| KeyLength(bytes.len()))
    }

    /// Makes a key whose bytes stay in `holder`, for example in memory that is never swapped out. A
    /// `SecretBox<[u8; 32]>` of the crate `secrecy` is a holder.
    ///
    /// The holder must erase the bytes on drop, and must return the same bytes each time.
    pub fn from_holder<H>(holder: H) -> Self
    where
        H: ExposeSecret<[u8; 32]> + Send + Sync + UnwindSafe + RefUnwindSafe + 'static,
    {
        Self(Box::new(holder))
    }

    /// Runs `derivation` on the key in a way that leaves nothing of the key on the stack.
    ///
    /// Libraries for hashes, HKDF and ciphers erase their states, but not values that they moved,
    /// spilled or returned by value. Their stack frames keep parts of the key and of everything
    /// derived from it. The derivation therefore runs a second time, with 32 zeros as the key. The
    /// same code at the same depth writes to the same places, uses no more stack, and also leaves
    /// registers without secrets. In addition, the upper part of that stack is overwritten.
    ///
    /// This requires that the derivation takes the same path for every key, as constant-time code
    /// does, and has no side effects. Its result is moved, so a secret in it has to be behind a
    /// pointer. A signal that interrupts the first run leaves registers on the stack.
    pub fn derive<T>(&self, derivation: impl Fn(&[u8; 32]) -> T) -> T {
        erasing_stack(|| {
            let derived = run(&derivation, self.expose_secret());
            // `black_box` prevents the compiler from omitting this run or compiling it differently.
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

/// Gives access to the key's bytes for the caller's own derivation. [`KmeKey::derive`] leaves
/// nothing of them on the stack.
impl ExposeSecret<[u8; 32]> for KmeKey {
    fn expose_secret(&self) -> &[u8; 32] {
        self.0.expose_secret()
    }
}

/// The function is never inlined, so that each run is the same code at the same stack depth.
#[inline(never)]
fn run<T>(derivation: &impl Fn(&[u8; 32]) -> T, key: &[u8; 32]) -> T {
    derivation(black_box(key))
}

/// Derives the AEAD for one KME key in one direction of one connection.
///
/// Every field is length-prefixed, so two different tuples never have the same info string.
pub(crate) fn aead<A: Aead>(channel: &Channel, key_id: &KeyId, key: &KmeKey) -> A {
    const LABEL: &[u8] = b"seal";
    let fields =
        [LABEL, key_id.as_bytes(), channel.sender(), channel.receiver(), channel.context()];
    let lengths = fields.map(|field| {
        // `KeyId` and `Channel` hold fields of at most 65,535 bytes.
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
