//! How strongly an address of a daemon is verified, from a proven link down to an unverified beacon.

/// What speaks for a daemon being where a beacon puts it, the best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AddressConfidence {
    /// A link with this very daemon stood there.
    Proven,
    /// This host lists the address, or had a link with somebody there; and the daemon answered there.
    KnownAnswered,
    /// This host lists the address, or had a link with somebody there.
    Known,
    /// The daemon answered a probe there.
    Answered,
    /// A beacon says so, whose source address may be forged.
    Heard,
}

impl AddressConfidence {
    /// How many there are.
    pub(super) const COUNT: usize = 5;
    /// All of them, the best first.
    pub(super) const ALL: [Self; Self::COUNT] =
        [Self::Proven, Self::KnownAnswered, Self::Known, Self::Answered, Self::Heard];
}
