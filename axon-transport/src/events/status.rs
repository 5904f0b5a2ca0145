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
    /// Every event.
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

    /// Whether it is a publisher's event; else it is a subscription's.
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

/// How often something happened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct CountStatus {
    /// In all.
    pub total: u64,
    /// Since the status was last taken.
    pub change: u64,
}

impl CountStatus {
    /// So often in all, and since the status was last taken.
    pub fn new(total: u64, change: u64) -> Self {
        Self { total, change }
    }
}

/// Endpoints that were and are matched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Matched {
    /// Matched ever.
    pub total: u64,
    /// Matched since the status was last taken.
    pub total_change: u64,
    /// Matched now.
    pub current: u64,
    /// The difference to when the status was last taken.
    pub current_change: i64,
}

impl Matched {
    /// So many ever and now, each with the difference to when the status was last taken.
    pub fn new(total: u64, total_change: u64, current: u64, current_change: i64) -> Self {
        Self { total, total_change, current, current_change }
    }
}

/// Endpoints whose QoS does not go with this one's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct IncompatibleQos {
    /// How many, ever.
    pub count: CountStatus,
    /// A policy that kept the last of them apart.
    pub last_policy: Option<Incompatible>,
}

/// A subscription's publishers, by whether they are alive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct LivelinessChanged {
    /// Alive now.
    pub alive: u64,
    /// Matched, and not alive now.
    pub not_alive: u64,
    /// The difference of `alive` to when the status was last taken.
    pub alive_change: i64,
    /// The difference of `not_alive` to when the status was last taken.
    pub not_alive_change: i64,
}

/// What is known of one event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventStatus {
    /// Of an event that is counted and no more.
    Counted(CountStatus),
    /// Of [`EventKind::SubscriptionMatched`] and [`EventKind::PublicationMatched`].
    Matched(Matched),
    /// Of [`EventKind::RequestedQosIncompatible`] and [`EventKind::OfferedQosIncompatible`].
    IncompatibleQos(IncompatibleQos),
    /// Of [`EventKind::LivelinessChanged`].
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
    /// A publisher's leases that ran out.
    lease: CountStatus,
    lost: CountStatus,
    /// Occurrences of each event since its status was last taken.
    unread: [u64; EventKind::ALL.len()],
}

impl Statuses {
    /// Those of a publisher.
    pub(crate) fn of_publisher() -> Self {
        Self::new(true)
    }

    /// Those of a subscription.
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

    /// How often the event occurred since its status was last taken. A wait set is woken while
    /// this is not 0.
    pub(crate) fn unread(&self, kind: EventKind) -> u64 {
        self.unread[kind as usize]
    }

    /// The status, whose changes are counted anew from here. `None` when the endpoint has no such
    /// event.
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

    /// An endpoint was matched.
    pub(crate) fn matched(&mut self) -> EventKind {
        self.matched.total += 1;
        self.matched.total_change += 1;
        self.matched.current += 1;
        self.matched.current_change += 1;
        self.occurred(EventKind::PublicationMatched, EventKind::SubscriptionMatched, 1)
    }

    /// An endpoint that was matched is so no more.
    pub(crate) fn unmatched(&mut self) -> EventKind {
        self.matched.current = self.matched.current.saturating_sub(1);
        self.matched.current_change -= 1;
        self.occurred(EventKind::PublicationMatched, EventKind::SubscriptionMatched, 1)
    }

    /// An endpoint was met whose QoS does not go with this one's.
    pub(crate) fn incompatible_qos(&mut self, policy: Incompatible) -> EventKind {
        self.incompatible_qos.count.add(1);
        self.incompatible_qos.last_policy = Some(policy);
        self.occurred(EventKind::OfferedQosIncompatible, EventKind::RequestedQosIncompatible, 1)
    }

    /// An endpoint of the same topic was met whose type is another.
    pub(crate) fn incompatible_type(&mut self) -> EventKind {
        self.incompatible_type.add(1);
        let (publisher, subscription) =
            (EventKind::PublisherIncompatibleType, EventKind::SubscriptionIncompatibleType);
        self.occurred(publisher, subscription, 1)
    }

    /// Deadlines were missed; at least one.
    pub(crate) fn deadlines_missed(&mut self, count: u64) -> EventKind {
        self.deadline.add(count);
        let (offered, requested) =
            (EventKind::OfferedDeadlineMissed, EventKind::RequestedDeadlineMissed);
        self.occurred(offered, requested, count)
    }

    /// A publisher's own lease ran out.
    pub(crate) fn liveliness_lost(&mut self) -> EventKind {
        self.lease.add(1);
        self.note(EventKind::LivelinessLost, 1)
    }

    /// A subscription lost samples; at least one.
    pub(crate) fn lost(&mut self, count: u64) -> EventKind {
        self.lost.add(count);
        self.note(EventKind::MessageLost, count)
    }

    /// A subscription's publishers are alive, or not, in these numbers.
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
        // Losses are counted by numbers that another host says.
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
