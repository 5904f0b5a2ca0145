//! Checked access to the pointers that a C program passes.

use std::{ffi::CStr, os::raw::c_char, slice};

use super::error::CallFailure;

/// Returns the string at `text`.
///
/// # Safety
/// `text` is null, or points to a string that ends with a 0 byte and stays valid during the call.
pub(super) unsafe fn text<'a>(text: *const c_char, what: &str) -> Result<&'a str, CallFailure> {
    if text.is_null() {
        return Err(CallFailure::argument(format_args!("{what} is null")));
    }
    // SAFETY: not null. The caller guarantees the rest.
    let bytes = unsafe { CStr::from_ptr(text) };
    bytes.to_str().map_err(|_| CallFailure::argument(format_args!("{what} is not UTF-8")))
}

/// Returns the elements at `data`.
///
/// # Safety
/// `data` is null, or points to `count` initialized elements that no thread writes to during the call.
pub(super) unsafe fn elements<'a, T: Copy>(
    data: *const T,
    count: usize,
    what: &str,
) -> Result<&'a [T], CallFailure> {
    if count == 0 {
        return Ok(&[]);
    }
    check(data, count, what)?;
    // SAFETY: not null, aligned, and no longer than an object may be. The caller guarantees the rest.
    Ok(unsafe { slice::from_raw_parts(data, count) })
}

/// Returns the elements at `data` as a mutable slice; see [`elements`].
///
/// # Safety
/// As for [`elements`]. In addition, no other code uses the elements during the call.
pub(super) unsafe fn elements_mut<'a, T: Copy>(
    data: *mut T,
    count: usize,
    what: &str,
) -> Result<&'a mut [T], CallFailure> {
    if count == 0 {
        return Ok(&mut []);
    }
    check(data, count, what)?;
    // SAFETY: as in `elements`. The caller guarantees that no other code uses the elements.
    Ok(unsafe { slice::from_raw_parts_mut(data, count) })
}

fn check<T>(data: *const T, count: usize, what: &str) -> Result<(), CallFailure> {
    let bytes = count.checked_mul(size_of::<T>()).and_then(|bytes| isize::try_from(bytes).ok());
    if bytes.is_none() {
        return Err(CallFailure::argument(format_args!("{what}: more than there can be")));
    }
    present(data, what)
}

/// Reads the value at `data`.
///
/// # Safety
/// `data` is null, or points to an initialized value that no thread writes to during the call.
pub(super) unsafe fn value<T: Copy>(data: *const T, what: &str) -> Result<T, CallFailure> {
    present(data, what)?;
    // SAFETY: not null and aligned. The caller guarantees the rest.
    Ok(unsafe { data.read() })
}

/// Stores `value` at `out`.
///
/// # Safety
/// `out` is null, or points to room for a value that no other code uses during the call. The room need not be
/// initialized.
pub(super) unsafe fn store<T>(out: *mut T, value: T, what: &str) -> Result<(), CallFailure> {
    present(out, what)?;
    // SAFETY: not null and aligned. The caller guarantees the rest.
    unsafe { out.write(value) };
    Ok(())
}

/// Stores `value` at `out` unless `out` is null.
///
/// # Safety
/// As for [`store`].
pub(super) unsafe fn store_if_wanted<T>(out: *mut T, value: T) -> Result<(), CallFailure> {
    if out.is_null() {
        return Ok(());
    }
    // SAFETY: guaranteed by the caller.
    unsafe { store(out, value, "the place of a result") }
}

/// Checks a pointer as [`present`] does, but accepts null.
pub(super) fn present_if_wanted<T>(data: *const T) -> Result<(), CallFailure> {
    if data.is_null() { Ok(()) } else { present(data, "the place of a result") }
}

/// Checks that `data` is neither null nor misaligned. Calls do this check before any work.
pub(super) fn present<T>(data: *const T, what: &str) -> Result<(), CallFailure> {
    if data.is_null() || !data.is_aligned() {
        return Err(CallFailure::argument(format_args!("{what} is null or not aligned")));
    }
    Ok(())
}
