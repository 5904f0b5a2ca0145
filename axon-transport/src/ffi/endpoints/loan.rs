//! The C functions of loans: memory that the program writes before it publishes the sample.

use std::sync::{Mutex, PoisonError};

use super::publisher::time;
use crate::ffi::{
    error::{AXON_RET_INVALID_HANDLE, CallFailure, axon_ret_t},
    guarded,
    handles::NamedLoan,
    handles::{axon_loan_t, axon_publisher_t, give, named, revoke},
    memory::{present, present_if_wanted, store, store_if_wanted},
};

/// Lends `len` bytes to be written and then published: in shared memory where they are more than
/// 4 KiB, or more than 512 bytes if the publisher was created to expect so many, so that nothing is
/// copied. They are at `data` and hold zeros or bytes of earlier samples.
/// Aligned to 16 is what is behind the first `header` of them, here and where they are taken in place:
/// 0 for all of them, 4 for a structure that follows a header of four bytes. Fewer than `len` may be published, so that what is serialized can be given its
/// upper bound. Blocks and fails as `axon_session_publisher_publish`.
///
/// One thread at a time may write. The bytes may be used until the loan is published or abandoned;
/// memory of a loan that is neither is lost to the publisher. A forked child may not use them.
///
/// # Safety
/// `loan` and `data` point to room for a handle and a pointer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_loan(
    publisher: axon_publisher_t,
    header: usize,
    len: usize,
    loan: *mut axon_loan_t,
    data: *mut *mut u8,
) -> axon_ret_t {
    guarded(|| {
        present(loan, "the place of the loan")?;
        present(data, "the place of the pointer")?;
        let publisher = named(publisher)?;
        let lent = publisher.loan_owned(header, len);
        let mut lent = lent.map_err(|e| CallFailure::from(e).of_endpoint(publisher.endpoint()))?;
        let at = lent.as_mut_ptr();
        let publisher = std::sync::Arc::downgrade(&publisher);
        let object = NamedLoan { len, loan: Mutex::new(Some(lent)), publisher };
        // SAFETY: the caller's word.
        unsafe { give(object, loan) }?;
        // SAFETY: the caller's word.
        unsafe { store(data, at, "the place of the pointer") }
    })
}

/// Publishes the first `len` bytes of a loan, as `axon_session_publisher_publish` does. The loan is
/// over, whatever this returns, but for AXON_RET_INVALID_ARGUMENT: `len` is more than was lent.
///
/// # Safety
/// `sequence` is null or points to room for a number. Nobody uses the loan's bytes any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_loan_publish(
    loan: axon_loan_t,
    len: usize,
    source_timestamp: i64,
    sequence: *mut u64,
) -> axon_ret_t {
    guarded(|| {
        present_if_wanted(sequence)?;
        let lent = named(loan)?.len;
        if len > lent {
            let text = format_args!("{len} bytes of a loan of {lent} cannot be published");
            return Err(CallFailure::argument(text));
        }
        let object = revoke(loan)?;
        let memory = object.loan.lock().unwrap_or_else(PoisonError::into_inner).take();
        let gone = |what| CallFailure::new(AXON_RET_INVALID_HANDLE, what);
        let publisher =
            object.publisher.upgrade().ok_or_else(|| gone("the loan's publisher is destroyed"))?;
        let memory = memory.ok_or_else(|| gone("the loan is over"))?;
        let published = memory.publish(len, time(source_timestamp));
        let number =
            published.map_err(|e| CallFailure::from(e).of_endpoint(publisher.endpoint()))?;
        // SAFETY: the caller's word.
        unsafe { store_if_wanted(sequence, number) }
    })
}

/// Gives a loan back without publishing it.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_loan_abandon(loan: axon_loan_t) -> axon_ret_t {
    guarded(|| revoke(loan).map(drop))
}
