//! Checked access to the pointers that a C program passes.

use std::{ffi::CStr, os::raw::c_char, slice};

use super::error::CallFailure;

/// The text at `text`.
///
/// # Safety
/// It is null, or points to a string that ends with a 0 byte and stands during the call.
pub(super) unsafe fn text<'a>(text: *const c_char, what: &str) -> Result<&'a str, CallFailure> {
    if text.is_null() {
        return Err(CallFailure::argument(format_args!("{what} is null")));
    }
    // SAFETY: not null, and the rest is the caller's word.
    let bytes = unsafe { CStr::from_ptr(text) };
    bytes.to_str().map_err(|_| CallFailure::argument(format_args!("{what} is not UTF-8")))
}

/// The elements at `data`.
///
/// # Safety
/// It points to `count` initialized elements that nobody writes to during the call, or is null.
pub(super) unsafe fn elements<'a, T: Copy>(
    data: *const T,
    count: usize,
    what: &str,
) -> Result<&'a [T], CallFailure> {
    if count == 0 {
        return Ok(&[]);
    }
    check(data, count, what)?;
    // SAFETY: not null, aligned, no longer than an object may be, and the rest is the caller's word.
    Ok(unsafe { slice::from_raw_parts(data, count) })
}

/// As [`elements`], to be written to.
///
/// # Safety
/// As there, and nobody else uses them during the call.
pub(super) unsafe fn elements_mut<'a, T: Copy>(
    data: *mut T,
    count: usize,
    what: &str,
) -> Result<&'a mut [T], CallFailure> {
    if count == 0 {
        return Ok(&mut []);
    }
    check(data, count, what)?;
    // SAFETY: as in `elements`, and the caller's word that nobody else uses them.
    Ok(unsafe { slice::from_raw_parts_mut(data, count) })
}

fn check<T>(data: *const T, count: usize, what: &str) -> Result<(), CallFailure> {
    let bytes = count.checked_mul(size_of::<T>()).and_then(|bytes| isize::try_from(bytes).ok());
    if bytes.is_none() {
        return Err(CallFailure::argument(format_args!("{what}: more than there can be")));
    }
    present(data, what)
}

/// What is at `data`.
///
/// # Safety
/// It is null, or points to an initialized value that nobody writes to during the call.
pub(super) unsafe fn value<T: Copy>(data: *const T, what: &str) -> Result<T, CallFailure> {
    present(data, what)?;
    // SAFETY: not null and aligned, and the rest is the caller's word.
    Ok(unsafe { data.read() })
}

/// Stores `value` at `out`.
///
/// # Safety
/// It is null, or points to room for a value that nobody else uses during the call. It need not be
/// initialized.
pub(super) unsafe fn store<T>(out: *mut T, value: T, what: &str) -> Result<(), CallFailure> {
    present(out, what)?;
    // SAFETY: not null and aligned, and the rest is the caller's word.
    unsafe { out.write(value) };
    Ok(())
}

/// As [`store`], where null says that the value is not wanted.
///
/// # Safety
/// As there.
pub(super) unsafe fn store_if_wanted<T>(out: *mut T, value: T) -> Result<(), CallFailure> {
    if out.is_null() {
        return Ok(());
    }
    // SAFETY: the caller's word.
    unsafe { store(out, value, "the place of a result") }
}

/// As [`present`], where null says that it is not wanted.
pub(super) fn present_if_wanted<T>(data: *const T) -> Result<(), CallFailure> {
    if data.is_null() { Ok(()) } else { present(data, "the place of a result") }
}

/// Checks that there can be something at `data`, before anything is done.
pub(super) fn present<T>(data: *const T, what: &str) -> Result<(), CallFailure> {
    if data.is_null() || !data.is_aligned() {
        return Err(CallFailure::argument(format_args!("{what} is null or not aligned")));
    }
    Ok(())
}
