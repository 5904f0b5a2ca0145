//! The object that a loan's handle names.

use std::sync::{Mutex, Weak};

use crate::session::{OwnedLoan, Publisher};

/// A loan, and the publisher that lent the memory.
pub(in crate::ffi) struct NamedLoan {
    pub(in crate::ffi) len: usize,
    pub(in crate::ffi) loan: Mutex<Option<OwnedLoan>>,
    /// Publishing the loan fails once the publisher is gone.
    pub(in crate::ffi) publisher: Weak<Publisher>,
}
