//! Decides which of two connections between the same daemons stays.

use axon_shm::ids::DaemonId;

use super::order::Side;

/// A connection that completed its HELLOs (and proof).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Candidate {
    /// The side of this daemon.
    pub side: Side,
    /// Whether the connection is the successor of a link that is up (for a new key or a new address).
    pub successor: bool,
}

/// Returns whether `new` takes the place of `current` between the daemons `ours` and `peer`. The daemon with the lower
/// id decides by the same rule.
///
/// A successor always does: it was dialled on purpose. Otherwise the lower id's own dial stays,
/// and of two dials by the same side the newer one, since a daemon dials again only when it gave
/// the first one up.
pub fn new_wins(ours: DaemonId, peer: DaemonId, current: Candidate, new: Candidate) -> bool {
    let dialled_by_lower = |c: Candidate| (c.side == Side::Client) == (ours < peer);
    new.successor
        || current.side == new.side
        || (dialled_by_lower(new) && !dialled_by_lower(current))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOW: DaemonId = DaemonId([1; 16]);
    const HIGH: DaemonId = DaemonId([2; 16]);

    fn plain(side: Side) -> Candidate {
        Candidate { side, successor: false }
    }

    #[test]
    fn both_ends_keep_the_dial_of_the_lower_id() {
        // At the lower id its own dial is the client's end, at the higher one the server's.
        assert!(new_wins(LOW, HIGH, plain(Side::Server), plain(Side::Client)));
        assert!(!new_wins(LOW, HIGH, plain(Side::Client), plain(Side::Server)));
        assert!(new_wins(HIGH, LOW, plain(Side::Client), plain(Side::Server)));
        assert!(!new_wins(HIGH, LOW, plain(Side::Server), plain(Side::Client)));
    }

    #[test]
    fn a_successor_replaces_a_link_whichever_side_dialled() {
        for side in [Side::Client, Side::Server] {
            let new = Candidate { side, successor: true };
            assert!(new_wins(LOW, HIGH, plain(Side::Client), new));
            assert!(new_wins(HIGH, LOW, plain(Side::Server), new));
        }
    }

    #[test]
    fn the_newer_of_two_dials_by_one_side_stays() {
        assert!(new_wins(LOW, HIGH, plain(Side::Server), plain(Side::Server)));
    }
}
