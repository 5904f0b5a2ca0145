//! Status counts: the total, and the change since the last read.

use crate::qos::Incompatible;

/// An event of a publisher or a subscription, under its ROS 2 name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum EventKind {
    /// A publisher of this subscription became alive or ceased to be.
    LivelinessChanged,
    /// No sample came for longer than the subscription's deadline.
    RequestedDeadlineMissed,
    /// A publisher offers less than the subscription requests.
    RequestedQosIncompatible,
    /// Samples were lost before they could be taken.
    MessageLost,
    /// A publisher of the topic has another type.
    SubscriptionIncompatibleType,
    /// A publisher was matched or unmatched.
    SubscriptionMatched,
    /// The publisher did not assert its liveliness within its lease.
    LivelinessLost,
    /// The publisher did not publish within its deadline.
    OfferedDeadlineMissed,
    /// A subscription requests more than the publisher offers.
    OfferedQosIncompatible,
    /// A subscription of the topic has another type.
    PublisherIncompatibleType,
    /// A subscription was matched or unmatched.
    PublicationMatched,
}

impl EventKind {
    /// All events.
    pub const ALL: [Self; 11] = [
        Self::LivelinessChanged,
        Self::RequestedDeadlineMissed,
        Self::RequestedQosIncompatible,
        Self::MessageLost,
        Self::SubscriptionIncompatibleType,
        Self::SubscriptionMatched,
        Self::LivelinessLost,
        Self::OfferedDeadlineMissed,
        Self::OfferedQosIncompatible,
        Self::PublisherIncompatibleType,
        Self::PublicationMatched,
    ];

    /// Returns whether this is a publisher's event. All other events are a subscription's.
    pub fn is_publishers(self) -> bool {
        matches!(
            self,
            Self::LivelinessLost
                | Self::OfferedDeadlineMissed
                | Self::OfferedQosIncompatible
                | Self::PublisherIncompatibleType
                | Self::PublicationMatched
        )
    }
}

/// The number of occurrences of an event.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct CountStatus {
    /// The total.
    pub total: u64,
    /// Occurrences since the status was last taken.
    pub change: u64,
}

impl CountStatus {
    /// Creates a status from the total count and the change since the last take.
    pub fn new(total: u64, change: u64) -> Self {
        Self { total, change }
    }
}

/// Numbers of matched endpoints.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Matched {
    /// Total number of matches.
    pub total: u64,
    /// Matches since the status was last taken.
    pub total_change: u64,
    /// Endpoints that are matched now.
    pub current: u64,
    /// Change of `current` since the status was last taken.
    pub current_change: i64,
}

impl Matched {
    /// Creates a status from the totals and their changes since the last take.
    pub fn new(total: u64, total_change: u64, current: u64, current_change: i64) -> Self {
        Self { total, total_change, current, current_change }
    }
}

/// Endpoints whose QoS is incompatible with this endpoint's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct IncompatibleQos {
    /// Number of such endpoints.
    pub count: CountStatus,
    /// An incompatible policy of the last such endpoint.
    pub last_policy: Option<Incompatible>,
}

/// Numbers of a subscription's publishers that are alive and not alive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct LivelinessChanged {
    /// Publishers that are alive now.
    pub alive: u64,
    /// Publishers that are matched and not alive now.
    pub not_alive: u64,
    /// Change of `alive` since the status was last taken.
    pub alive_change: i64,
    /// Change of `not_alive` since the status was last taken.
    pub not_alive_change: i64,
}

/// The status of one event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventStatus {
    /// The status of an event that is only counted.
    Counted(CountStatus),
    /// The status of [`EventKind::SubscriptionMatched`] and [`EventKind::PublicationMatched`].
    Matched(Matched),
    /// The status of [`EventKind::RequestedQosIncompatible`] and [`EventKind::OfferedQosIncompatible`].
    IncompatibleQos(IncompatibleQos),
    /// The status of [`EventKind::LivelinessChanged`].
    LivelinessChanged(LivelinessChanged),
}

/// The statuses of one endpoint, publisher or subscription.
#[derive(Clone, Debug)]
pub(crate) struct Statuses {
    publisher: bool,
    matched: Matched,
    liveliness: LivelinessChanged,
    incompatible_qos: IncompatibleQos,
    incompatible_type: CountStatus,
    deadline: CountStatus,
    /// Expired leases of a publisher.
    lease: CountStatus,
    lost: CountStatus,
    /// Occurrences of each event since its status was last taken.
    unread: [u64; EventKind::ALL.len()],
}

impl Statuses {
    /// Creates the statuses of a publisher.
    pub(crate) fn of_publisher() -> Self {
        Self::new(true)
    }

    /// Creates the statuses of a subscription.
    pub(crate) fn of_subscription() -> Self {
        Self::new(false)
    }

    fn new(publisher: bool) -> Self {
        Self {
            publisher,
            matched: Matched::default(),
            liveliness: LivelinessChanged::default(),
            incompatible_qos: IncompatibleQos::default(),
            incompatible_type: CountStatus::default(),
            deadline: CountStatus::default(),
            lease: CountStatus::default(),
            lost: CountStatus::default(),
            unread: [0; EventKind::ALL.len()],
        }
    }

    /// Returns the occurrences of the event since its status was last taken. A wait set is woken while this
    /// is not 0.
    pub(crate) fn unread(&self, kind: EventKind) -> u64 {
        self.unread[kind as usize]
    }

    /// Returns the status and resets its changes. Returns `None` if the endpoint has no such event.
    pub(crate) fn take(&mut self, kind: EventKind) -> Option<EventStatus> {
        if kind.is_publishers() != self.publisher {
            return None;
        }
        self.unread[kind as usize] = 0;
        Some(match kind {
            EventKind::SubscriptionMatched | EventKind::PublicationMatched => {
                let status = self.matched;
                self.matched = Matched { total_change: 0, current_change: 0, ..status };
                EventStatus::Matched(status)
            }
            EventKind::LivelinessChanged => {
                let status = self.liveliness;
                self.liveliness =
                    LivelinessChanged { alive_change: 0, not_alive_change: 0, ..status };
                EventStatus::LivelinessChanged(status)
            }
            EventKind::RequestedQosIncompatible | EventKind::OfferedQosIncompatible => {
                let status = self.incompatible_qos;
                self.incompatible_qos.count.change = 0;
                EventStatus::IncompatibleQos(status)
            }
            EventKind::SubscriptionIncompatibleType | EventKind::PublisherIncompatibleType => {
                EventStatus::Counted(self.incompatible_type.take())
            }
            EventKind::RequestedDeadlineMissed | EventKind::OfferedDeadlineMissed => {
                EventStatus::Counted(self.deadline.take())
            }
            EventKind::LivelinessLost => EventStatus::Counted(self.lease.take()),
            EventKind::MessageLost => EventStatus::Counted(self.lost.take()),
        })
    }

    /// Counts a match.
    pub(crate) fn matched(&mut self) -> EventKind {
        self.matched.total += 1;
        self.matched.total_change += 1;
        self.matched.current += 1;
        self.matched.current_change += 1;
        self.occurred(EventKind::PublicationMatched, EventKind::SubscriptionMatched, 1)
    }

    /// Counts the end of a match.
    pub(crate) fn unmatched(&mut self) -> EventKind {
        self.matched.current = self.matched.current.saturating_sub(1);
        self.matched.current_change -= 1;
        self.occurred(EventKind::PublicationMatched, EventKind::SubscriptionMatched, 1)
    }

    /// Counts an endpoint whose QoS is incompatible with this endpoint's.
    pub(crate) fn incompatible_qos(&mut self, policy: Incompatible) -> EventKind {
        self.incompatible_qos.count.add(1);
        self.incompatible_qos.last_policy = Some(policy);
        self.occurred(EventKind::OfferedQosIncompatible, EventKind::RequestedQosIncompatible, 1)
    }

    /// Counts an endpoint of the same topic with another type.
    pub(crate) fn incompatible_type(&mut self) -> EventKind {
        self.incompatible_type.add(1);
        let (publisher, subscription) =
            (EventKind::PublisherIncompatibleType, EventKind::SubscriptionIncompatibleType);
        self.occurred(publisher, subscription, 1)
    }

    /// Counts missed deadlines. `count` is at least 1.
    pub(crate) fn deadlines_missed(&mut self, count: u64) -> EventKind {
        self.deadline.add(count);
        let (offered, requested) =
            (EventKind::OfferedDeadlineMissed, EventKind::RequestedDeadlineMissed);
        self.occurred(offered, requested, count)
    }

    /// Counts an expiry of a publisher's own lease.
    pub(crate) fn liveliness_lost(&mut self) -> EventKind {
        self.lease.add(1);
        self.note(EventKind::LivelinessLost, 1)
    }

    /// Counts samples that a subscription lost. `count` is at least 1.
    pub(crate) fn lost(&mut self, count: u64) -> EventKind {
        self.lost.add(count);
        self.note(EventKind::MessageLost, count)
    }

    /// Adds to the numbers of a subscription's publishers that are alive and not alive.
    pub(crate) fn liveliness_changed(&mut self, alive: i64, not_alive: i64) -> EventKind {
        let status = &mut self.liveliness;
        status.alive = status.alive.saturating_add_signed(alive);
        status.not_alive = status.not_alive.saturating_add_signed(not_alive);
        status.alive_change += alive;
        status.not_alive_change += not_alive;
        self.note(EventKind::LivelinessChanged, 1)
    }

    fn occurred(
        &mut self,
        publishers: EventKind,
        subscriptions: EventKind,
        count: u64,
    ) -> EventKind {
        self.note(if self.publisher { publishers } else { subscriptions }, count)
    }

    fn note(&mut self, kind: EventKind, count: u64) -> EventKind {
        debug_assert_eq!(kind.is_publishers(), self.publisher);
        let unread = &mut self.unread[kind as usize];
        *unread = unread.saturating_add(count);
        kind
    }
}

impl CountStatus {
    fn add(&mut self, count: u64) {
        // Another host may state the number of lost samples, so the sum saturates.
        self.total = self.total.saturating_add(count);
        self.change = self.change.saturating_add(count);
    }

    fn take(&mut self) -> Self {
        let status = *self;
        self.change = 0;
        status
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_counted_from_the_last_look_and_totals_for_ever() {
        let mut statuses = Statuses::of_subscription();
        statuses.matched();
        statuses.matched();
        statuses.unmatched();
        let kind = EventKind::SubscriptionMatched;
        assert_eq!(statuses.unread(kind), 3);
        let first = Matched { total: 2, total_change: 2, current: 1, current_change: 1 };
        assert_eq!(statuses.take(kind), Some(EventStatus::Matched(first)));
        assert_eq!(statuses.unread(kind), 0);
        statuses.unmatched();
        let second = Matched { total: 2, total_change: 0, current: 0, current_change: -1 };
        assert_eq!(statuses.take(kind), Some(EventStatus::Matched(second)));
        let rest = Matched { current_change: 0, ..second };
        assert_eq!(statuses.take(kind), Some(EventStatus::Matched(rest)));
    }

    #[test]
    fn each_event_is_counted_under_its_own_name_and_under_no_other() {
        type Cause = fn(&mut Statuses) -> EventKind;
        let both: [(Cause, EventKind, EventKind); 4] = [
            (Statuses::matched, EventKind::PublicationMatched, EventKind::SubscriptionMatched),
            (
                |s| s.incompatible_qos(Incompatible::Deadline),
                EventKind::OfferedQosIncompatible,
                EventKind::RequestedQosIncompatible,
            ),
            (
                Statuses::incompatible_type,
                EventKind::PublisherIncompatibleType,
                EventKind::SubscriptionIncompatibleType,
            ),
            (
                |s| s.deadlines_missed(1),
                EventKind::OfferedDeadlineMissed,
                EventKind::RequestedDeadlineMissed,
            ),
        ];
        let mut cases: Vec<(Statuses, Cause, EventKind)> = Vec::new();
        for (cause, publishers, subscriptions) in both {
            cases.push((Statuses::of_publisher(), cause, publishers));
            cases.push((Statuses::of_subscription(), cause, subscriptions));
        }
        cases.push((
            Statuses::of_publisher(),
            Statuses::liveliness_lost,
            EventKind::LivelinessLost,
        ));
        cases.push((Statuses::of_subscription(), |s| s.lost(1), EventKind::MessageLost));
        let changed: Cause = |s| s.liveliness_changed(1, 0);
        cases.push((Statuses::of_subscription(), changed, EventKind::LivelinessChanged));
        assert_eq!(cases.len(), EventKind::ALL.len());
        for (mut statuses, cause, expected) in cases {
            assert_eq!(cause(&mut statuses), expected);
            for kind in EventKind::ALL {
                assert_eq!(statuses.unread(kind), u64::from(kind == expected), "{kind:?}");
                let own = kind.is_publishers() == expected.is_publishers();
                assert_eq!(statuses.take(kind).is_some(), own, "{kind:?}");
            }
        }
    }

    #[test]
    fn the_policy_that_was_found_last_is_kept() {
        let mut statuses = Statuses::of_publisher();
        let kind = EventKind::OfferedQosIncompatible;
        let nothing = EventStatus::IncompatibleQos(IncompatibleQos::default());
        assert_eq!(statuses.take(kind), Some(nothing));
        statuses.incompatible_qos(Incompatible::Durability);
        statuses.incompatible_qos(Incompatible::Reliability);
        let expected = |change| {
            let count = CountStatus { total: 2, change };
            let last_policy = Some(Incompatible::Reliability);
            Some(EventStatus::IncompatibleQos(IncompatibleQos { count, last_policy }))
        };
        assert_eq!(statuses.take(kind), expected(2));
        assert_eq!(statuses.take(kind), expected(0));
    }
}
