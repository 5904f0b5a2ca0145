//! What a loan's handle names.

use std::sync::{Mutex, Weak};

use crate::session::{OwnedLoan, Publisher};

/// A loan, and the publisher that lent it.
pub(super) struct NamedLoan {
    pub(super) len: usize,
    pub(super) loan: Mutex<Option<OwnedLoan>>,
    /// It must be there for the loan to be published.
    pub(super) publisher: Weak<Publisher>,
}
