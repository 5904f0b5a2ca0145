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

/// Lends `len` bytes of memory at `data`, which the program writes and then publishes. The memory is shared
/// memory if `len` is more than 4 KiB, or more than 512 bytes for a publisher that expects samples of more
/// than 512 bytes. Such a sample is published without a copy. The bytes hold zeros or data of earlier
/// samples.
///
/// The byte after the first `header` bytes is aligned to 16, both here and where the sample is taken in
/// place. Pass 0 to align the whole sample, or 4 for a structure that follows a header of four bytes. The
/// program may publish fewer than `len` bytes, so `len` can be an upper bound of the serialized size. Blocks
/// and fails as `axon_session_publisher_publish` does.
///
/// One thread at a time may write. The bytes may be used until the loan is published or abandoned. The
/// publisher loses the memory of a loan that is neither published nor abandoned. A forked child may not use
/// the bytes.
///
/// # Safety
/// `loan` points to room for a handle, and `data` to room for a pointer.
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
        // SAFETY: guaranteed by the caller.
        unsafe { give(object, loan) }?;
        // SAFETY: guaranteed by the caller.
        unsafe { store(data, at, "the place of the pointer") }
    })
}

/// Publishes the first `len` bytes of a loan, as `axon_session_publisher_publish` does. The loan ends with
/// every result except AXON_RET_INVALID_ARGUMENT: `len` is more than was lent.
///
/// # Safety
/// `sequence` is null or points to room for a number. No code uses the loan's bytes from now on.
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
        // SAFETY: guaranteed by the caller.
        unsafe { store_if_wanted(sequence, number) }
    })
}

/// Gives a loan back without publishing it.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_loan_abandon(loan: axon_loan_t) -> axon_ret_t {
    guarded(|| revoke(loan).map(drop))
}
