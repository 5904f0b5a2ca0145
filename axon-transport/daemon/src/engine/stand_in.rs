//! Stand-ins: local writers for remote publishers, clients and servers.

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    fmt,
    rc::{Rc, Weak},
    time::Duration,
};

use axon_shm::{Meta, ids::Gid};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    internal::session::Written,
};

use super::{
    rings::{RingError, RingWriter, Rings},
    sample::{
        dropped::{DroppedRuns, EarlierFate},
        numbers::{FORGOTTEN, PublisherNumbers},
    },
};
use crate::engine::account::{Account, Charge};

/// A local writer for a remote endpoint. A link and its successor share the stand-in.
pub(crate) struct StandIn {
    ring: Rc<dyn RingWriter>,
    gid: Gid,
    /// True if sequence numbers rise, as those of samples and requests do. A server answers calls in any
    /// order.
    rises: bool,
    /// The last written sequence number; 0 if there is none.
    last: Cell<u64>,
    /// The newest samples that were dropped here.
    dropped: RefCell<DroppedRuns>,
    /// The sequence numbers that the publisher can have reached.
    numbers: Rc<PublisherNumbers>,
    _place: Charge,
}

impl StandIn {
    /// Returns the remote endpoint's GID.
    pub(crate) fn gid(&self) -> Gid {
        self.gid
    }

    /// Returns the stand-in's ring.
    pub(crate) fn ring(&self) -> &dyn RingWriter {
        &*self.ring
    }

    /// Writes a sample. A sleeping subscription may stay asleep until [`announce`](Self::announce).
    ///
    /// # Errors
    /// The ring is full, or the sample is lost. A sample is also lost if its publisher cannot have reached
    /// its number.
    pub(crate) fn try_write(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
        now: Duration,
    ) -> Result<Written, RingError> {
        let sequence = meta.sequence;
        if self.rises {
            self.numbers.judge(sequence, now).map_err(RingError::Lost)?;
        }
        let written = self.ring.try_write(client, meta, payload)?;
        self.last.set(sequence);
        if self.rises {
            self.numbers.pass(sequence, now);
        }
        Ok(written)
    }

    /// Writes the copy of a sample. Returns whether a reader gets it. If none does, nothing changes: the sample itself is
    /// still to come.
    pub(crate) fn try_write_copy(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
        now: Duration,
    ) -> bool {
        let sequence = meta.sequence;
        if self.rises && self.numbers.judge(sequence, now).is_err() {
            return false;
        }
        if !matches!(self.ring.try_write(client, meta, payload), Ok(Written::Yes)) {
            return false;
        }
        self.last.set(sequence);
        if self.rises {
            self.numbers.pass(sequence, now);
        }
        true
    }

    /// Returns whether nothing ever came from its publisher or client, before this stand-in was created either.
    pub(crate) fn is_new(&self) -> bool {
        self.numbers.last() == 0
    }

    /// Wakes the sleeping subscriptions once for all written samples.
    pub(crate) fn announce(&self) {
        self.ring.announce();
    }

    /// Returns the number of the newest sample of a publisher, or request of a client, in the ring.
    pub(crate) fn last_sequence(&self) -> Option<u64> {
        Some(self.last.get()).filter(|last| self.rises && *last > 0)
    }

    /// Records that a sample was dropped here by a limit or for lack of room. Do not call this for an
    /// impossible number: the sample that truly has the number may still arrive.
    pub(crate) fn drop_sample(&self, sequence: u64) {
        if self.rises {
            self.dropped.borrow_mut().add(sequence);
        }
    }

    /// Returns the earlier fate of a sample, which may have been dropped here before. A publisher whose link broke
    /// sends such a sample again.
    pub(crate) fn dropped(&self, sequence: u64) -> EarlierFate {
        self.dropped.borrow().find(sequence)
    }
}

impl fmt::Debug for StandIn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("StandIn").field(&self.gid).finish()
    }
}

/// The reason for which an endpoint has no stand-in.
#[derive(Debug)]
pub(crate) enum NoStandIn {
    /// The identity that announced the endpoint has as many stand-ins as its limit permits.
    TooMany,
    /// The stand-in could not be created for this reason.
    Failed(String),
}

/// A stand-in, or the numbers of one that is gone.
#[derive(Debug)]
struct Known {
    stand_in: Weak<StandIn>,
    numbers: Rc<PublisherNumbers>,
    /// The budget of the identity that announced the endpoint.
    identity: Rc<str>,
}

/// All stand-ins of this host.
#[derive(Default)]
pub(crate) struct StandIns {
    known: RefCell<HashMap<Gid, Known>>,
    /// The number of known entries at which the entries of gone stand-ins are forgotten.
    clean_at: Cell<usize>,
}

/// The lowest number of known entries at which the entries of gone stand-ins are forgotten.
const KNOWN: usize = 64;
/// The most gone publishers whose numbers are remembered, so that a publisher that returns continues from its
/// number. Beyond that, each identity keeps its newest entries up to an equal share.
const MAX_GONE_PUBLISHERS: usize = if cfg!(test) { 60 } else { 1 << 16 };

impl StandIns {
    /// Returns the stand-in for `remote`: the existing one, or a new one that is charged to `account`.
    ///
    /// # Errors
    /// [`NoStandIn`].
    pub(crate) fn get(
        &self,
        rings: &dyn Rings,
        remote: &Endpoint,
        account: &Account,
        now: Duration,
    ) -> Result<Rc<StandIn>, NoStandIn> {
        let mut known = self.known.borrow_mut();
        let before = known.get(&remote.gid);
        if let Some(stand_in) = before.and_then(|known| known.stand_in.upgrade()) {
            if stand_in.ring.endpoint() == remote {
                return Ok(stand_in);
            }
            return Err(NoStandIn::Failed(format!("{} stands for another endpoint", remote.gid)));
        }
        let numbers =
            before.map_or_else(|| Rc::new(PublisherNumbers::new(now)), |b| Rc::clone(&b.numbers));
        let Some(place) = account.stand_ins.charge(1) else { return Err(NoStandIn::TooMany) };
        let stand_in = Rc::new(StandIn {
            ring: rings.open_writer(remote, &account.held).map_err(NoStandIn::Failed)?,
            gid: remote.gid,
            rises: remote.kind != EndpointKind::Server,
            last: Cell::new(0),
            dropped: RefCell::default(),
            numbers: Rc::clone(&numbers),
            _place: place,
        });
        // Cleaning only when the number has doubled keeps the cost per entry constant.
        if known.len() >= self.clean_at.get() {
            forget(&mut known, now);
            self.clean_at.set(2 * known.len().max(KNOWN));
        }
        let identity = Rc::clone(&account.budget);
        let stand_in_known = Known { stand_in: Rc::downgrade(&stand_in), numbers, identity };
        known.insert(remote.gid, stand_in_known);
        Ok(stand_in)
    }
}

/// Forgets the entries of gone stand-ins, but keeps recent numbers.
fn forget(known: &mut HashMap<Gid, Known>, now: Duration) {
    let is_there = |known: &Known| known.stand_in.strong_count() > 0;
    let recent = |known: &Known| known.numbers.last() > 0 && now < known.numbers.at() + FORGOTTEN;
    known.retain(|_, known| is_there(known) || recent(known));
    let mut gone = HashMap::<_, Vec<_>>::new();
    for (gid, known) in known.iter().filter(|(_, known)| !is_there(known)) {
        gone.entry(Rc::clone(&known.identity)).or_default().push((known.numbers.at(), *gid));
    }
    let share = share(gone.values().map(Vec::len).collect(), MAX_GONE_PUBLISHERS);
    for mut of_identity in gone.into_values().filter(|gone| gone.len() > share) {
        of_identity.sort_unstable();
        let oldest = of_identity.len() - share;
        of_identity[..oldest].iter().for_each(|(_, gid)| drop(known.remove(gid)));
    }
}

/// Returns the largest share per identity with which all together have at most `all`.
fn share(mut wanted: Vec<usize>, all: usize) -> usize {
    wanted.sort_unstable();
    let (mut left, mut others) = (all, wanted.len());
    for want in wanted {
        if want > left / others {
            return left / others;
        }
        left -= want;
        others -= 1;
    }
    usize::MAX
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::account::Accounts;

    #[test]
    fn the_unused_part_of_an_equal_share_goes_to_larger_demands() {
        assert_eq!(share(vec![], 60), usize::MAX);
        assert_eq!(share(vec![10, 20, 30], 60), usize::MAX);
        assert_eq!(share(vec![100], 60), 60);
        assert_eq!(share(vec![10, 100, 100], 60), 25);
        assert_eq!(share(vec![100; 100], 60), 0);
    }

    fn departed(identity: &Rc<str>, number: u8, at: u64) -> (Gid, Known) {
        let numbers = Rc::new(PublisherNumbers::new(Duration::ZERO));
        numbers.pass(1, Duration::from_secs(at));
        let mut gid = Gid::default();
        gid.0[0] = number;
        (gid, Known { stand_in: Weak::new(), numbers, identity: Rc::clone(identity) })
    }

    #[test]
    fn an_identity_whose_publishers_come_and_go_has_none_of_another_forgotten() {
        let mut accounts = Accounts::new(1 << 20, 1 << 20);
        let [flood, quiet] = ["flood", "quiet"].map(|of| Rc::clone(&accounts.of_one(of).budget));
        let mut known = HashMap::new();
        known.extend((0..10).map(|number| departed(&quiet, number, 1)));
        known.extend((10..210).map(|number| departed(&flood, number, u64::from(number))));
        forget(&mut known, Duration::from_secs(300));
        let mut left: Vec<u8> = known.keys().map(|gid| gid.0[0]).collect();
        left.sort_unstable();
        assert_eq!(
            left,
            (0..10).chain(160..210).collect::<Vec<_>>(),
            "and the newest of the flood"
        );
    }
}
