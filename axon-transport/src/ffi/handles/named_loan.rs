//! What a loan's handle names.

use std::sync::{Mutex, Weak};

use crate::session::{OwnedLoan, Publisher};

/// A loan, and the publisher that lent it.
pub(in crate::ffi) struct NamedLoan {
    pub(in crate::ffi) len: usize,
    pub(in crate::ffi) loan: Mutex<Option<OwnedLoan>>,
    /// It must be there for the loan to be published.
    pub(in crate::ffi) publisher: Weak<Publisher>,
}
