//! Watches the statuses of a publisher or subscription: the sum of the changes must equal the reported totals.

use std::cell::{Cell, RefCell};

use axon_transport::{
    Event, Publisher, Subscription,
    events::{CountStatus, EventKind, EventStatus},
};

use super::orders::Reported;

pub(super) struct Watch {
    matched: Event,
    qos: Event,
    types: Event,
    late: Event,
    /// LIVELINESS_CHANGED of a subscription, or LIVELINESS_LOST of a publisher.
    life: Event,
    lost: Option<Event>,
    sums: RefCell<Sums>,
    /// Number of lost and expired samples that the test has accounted for.
    gone: Cell<u64>,
}

/// The sums of all changes since the endpoint was created.
#[derive(Default)]
struct Sums {
    ever: u64,
    current: i64,
    qos: u64,
    types: u64,
    late: u64,
    lifeless: u64,
    alive: i64,
    not_alive: i64,
}

impl Watch {
    pub(super) fn publisher(publisher: &Publisher) -> Self {
        Self::of(
            |kind| publisher.event(kind),
            [
                EventKind::PublicationMatched,
                EventKind::OfferedQosIncompatible,
                EventKind::PublisherIncompatibleType,
                EventKind::OfferedDeadlineMissed,
                EventKind::LivelinessLost,
            ],
        )
    }

    pub(super) fn subscription(subscription: &Subscription) -> Self {
        Self::of(
            |kind| subscription.event(kind),
            [
                EventKind::SubscriptionMatched,
                EventKind::RequestedQosIncompatible,
                EventKind::SubscriptionIncompatibleType,
                EventKind::RequestedDeadlineMissed,
                EventKind::LivelinessChanged,
            ],
        )
    }

    fn of(event: impl Fn(EventKind) -> Option<Event>, kinds: [EventKind; 5]) -> Self {
        let [matched, qos, types, late, life] = kinds.map(|kind| event(kind).unwrap());
        let lost = event(EventKind::MessageLost);
        let (sums, gone) = (RefCell::default(), Cell::new(0));
        Self { matched, qos, types, late, life, lost, sums, gone }
    }

    /// Returns the event of a subscription's losses.
    pub(super) fn lost(&self) -> &Event {
        self.lost.as_ref().expect("a subscription's")
    }

    pub(super) fn gone_before(&self) -> u64 {
        self.gone.get()
    }

    pub(super) fn have_gone(&self, gone: u64) {
        self.gone.set(gone);
    }

    pub(super) fn report(&self) -> Reported {
        let mut sums = self.sums.borrow_mut();
        let sums = &mut *sums;
        let EventStatus::Matched(matched) = self.matched.take() else { unreachable!() };
        sums.ever += matched.total_change;
        sums.current += matched.current_change;
        let current = i64::try_from(matched.current).unwrap();
        assert_eq!((sums.ever, sums.current), (matched.total, current), "{matched:?}");
        let EventStatus::IncompatibleQos(qos) = self.qos.take() else { unreachable!() };
        added(&mut sums.qos, qos.count);
        let types = counted(&self.types, &mut sums.types);
        let late = counted(&self.late, &mut sums.late);
        let mut reported = Reported {
            ever: matched.total,
            current: matched.current,
            qos: qos.count.total,
            policy: qos.last_policy.map(|policy| policy.to_string()),
            types,
            late,
            ..Reported::default()
        };
        if self.life.kind() == EventKind::LivelinessLost {
            reported.lifeless = counted(&self.life, &mut sums.lifeless);
        } else {
            let EventStatus::LivelinessChanged(life) = self.life.take() else { unreachable!() };
            sums.alive += life.alive_change;
            sums.not_alive += life.not_alive_change;
            let now = [life.alive, life.not_alive].map(|count| i64::try_from(count).unwrap());
            assert_eq!([sums.alive, sums.not_alive], now, "{life:?}");
            (reported.alive, reported.not_alive) = (life.alive, life.not_alive);
        }
        reported
    }
}

fn counted(event: &Event, sum: &mut u64) -> u64 {
    let EventStatus::Counted(status) = event.take() else { unreachable!() };
    added(sum, status);
    status.total
}

fn added(sum: &mut u64, status: CountStatus) {
    *sum += status.change;
    assert_eq!(*sum, status.total, "{status:?}");
}
