//! The degree to which an address of a daemon is verified, from a proven link down to an unverified beacon.

/// The evidence that a daemon is at the address that a beacon gives, the strongest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AddressConfidence {
    /// A link with this daemon stood there.
    Proven,
    /// This host lists the address or had a link with a peer there, and the daemon answered there.
    KnownAnswered,
    /// This host lists the address or had a link with a peer there.
    Known,
    /// The daemon answered a probe there.
    Answered,
    /// Only a beacon gives the address, and its source address may be forged.
    Heard,
}

impl AddressConfidence {
    /// Number of the levels.
    pub(super) const COUNT: usize = 5;
    /// All levels, the best first.
    pub(super) const ALL: [Self; Self::COUNT] =
        [Self::Proven, Self::KnownAnswered, Self::Known, Self::Answered, Self::Heard];
}
