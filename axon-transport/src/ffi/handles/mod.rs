//! Handles, and the tables of the objects that they name.

mod handle;
mod named_loan;
mod table;

pub use self::handle::*;
pub(in crate::ffi) use self::named_loan::NamedLoan;
