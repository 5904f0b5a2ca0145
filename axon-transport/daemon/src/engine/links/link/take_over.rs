//! Why a link comes in use.

use crate::link::Elected;

/// The reason why a link comes in use.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine::links) enum TakeOver {
    /// The peer elected it.
    Elected(Elected),
    /// The peer asks this side to elect the link, which stands by.
    SwitchOver,
    /// The peer dialled it, and this side elects.
    Dialled,
}
