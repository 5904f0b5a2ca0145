//! Effects: the actions that the engine requests of its owner, in order.

use std::{collections::VecDeque, sync::Arc};

use axon_shm::ids::DaemonId;

use super::{
    compression::CompressionOrder,
    counters::{self, TopicLoss},
    links::LinkReport,
    peer::StalledRoute,
    refusal::{Refusal, RefusedBy},
};
use crate::{
    bridge::{RefusalKind, ToControl},
    keys::{KmeRequest, RequestOrigin},
};

/// An action that the engine requests of its owner.
#[derive(Debug)]
pub(crate) enum Effect {
    /// Send a message to the control plane.
    Tell(ToControl),
    /// Ask the KME; the answer comes back by [`Engine::handle_key_event`](super::Engine::handle_key_event).
    Kme(RequestOrigin, KmeRequest),
    /// Record a key in the ledger of used keys; the result comes back by
    /// [`Engine::handle_recorded`](super::Engine::handle_recorded).
    Record {
        /// The connection.
        link: u64,
        /// The key.
        key_id: String,
    },
    /// List this host's network interfaces; the list comes back by
    /// [`Engine::handle_interfaces`](super::Engine::handle_interfaces).
    Interfaces,
    /// Return freed memory to the system after a while.
    ReturnMemory,
    /// Compress a sample, on another thread; the answer comes back by
    /// [`Engine::handle_compressed`](super::Engine::handle_compressed).
    Compress(CompressionOrder),
}

/// Effects that the owner has not taken yet.
#[derive(Default)]
pub(super) struct Effects {
    waiting: VecDeque<Effect>,
    /// The state that [`tell_draining`](Self::tell_draining) last reported.
    draining: bool,
}

impl Effects {
    /// Adds an effect.
    pub(super) fn push(&mut self, effect: Effect) {
        self.waiting.push_back(effect);
    }

    /// Requests a message to the control plane.
    pub(super) fn tell(&mut self, what: ToControl) {
        self.push(Effect::Tell(what));
    }

    /// Reports to the control plane whether samples of ended publishers are still being sent, if that
    /// changed.
    pub(super) fn tell_draining(&mut self, draining: bool) {
        if std::mem::replace(&mut self.draining, draining) != draining {
            self.tell(ToControl::Draining(draining));
        }
    }

    /// Logs losses and reports them to the control plane.
    pub(super) fn tell_lost(&mut self, peer: &str, losses: Vec<TopicLoss>) {
        counters::log(&losses, peer);
        for TopicLoss { topic, cause, samples } in losses {
            self.tell(ToControl::Lost { topic: topic.to_string(), cause, samples });
        }
    }

    /// Reports the end of a peer's last link. Logs the unacknowledged samples by topic, and reports the
    /// losses in `counted` to the control plane.
    pub(super) fn tell_link_over(
        &mut self,
        daemon: DaemonId,
        peer: &str,
        unacknowledged: &[(Arc<str>, u64)],
        counted: Vec<TopicLoss>,
    ) {
        if !unacknowledged.is_empty() {
            let all = unacknowledged.iter().map(|(topic, samples)| (&**topic, *samples));
            let (topics, samples) = counters::by_topic(all);
            tracing::warn!(peer = %daemon, samples, topics,
                "the link ended before the peer acknowledged them: samples may be lost");
        }
        self.tell_lost(peer, counted);
    }

    /// Logs and reports the samples, by topic, of relays that were kept for peers that did not return.
    pub(super) fn tell_relays_given_up(&mut self, given_up: Vec<(String, u64)>) {
        if given_up.is_empty() {
            return;
        }
        let all = given_up.iter().map(|(topic, samples)| (&**topic, *samples));
        let (topics, samples) = counters::by_topic(all);
        tracing::warn!(
            samples,
            topics,
            "a peer's daemon was restarted and did not ask for the topics again: samples are lost"
        );
        for (topic, samples) in given_up {
            self.tell(ToControl::Lost { topic, cause: "link_ended", samples });
        }
    }

    /// Logs and reports that a peer does not read a route that it asked for.
    pub(super) fn tell_stalled(&mut self, kind: RefusalKind, peer: String, stalled: StalledRoute) {
        let StalledRoute { topic, reason, samples } = stalled;
        tracing::warn!(topic, samples, "samples are lost: a peer does not read the topic");
        let what = format!("topic {topic}");
        self.tell(ToControl::Refusal { kind, peer, what, reason });
        self.tell(ToControl::Lost { topic, cause: "stalled", samples });
    }

    /// Passes on a report of the links.
    pub(super) fn tell_report(&mut self, report: LinkReport) {
        match report {
            LinkReport::Refused(kind, peer, refusal) => self.tell_refused(kind, peer, refusal),
            LinkReport::DialFailed { daemon, standing, absent_at } => {
                self.tell(ToControl::DialFailed { daemon, standing, absent_at });
            }
            LinkReport::Up { daemon, address, proven } => {
                self.tell(ToControl::LinkUp { daemon, address, proven });
            }
            LinkReport::Path { daemon, works } => self.tell(ToControl::Path { daemon, works }),
            LinkReport::Datagrams(datagrams) => self.tell(ToControl::Datagrams(datagrams)),
        }
    }

    /// Reports a refusal to the control plane, which logs it.
    fn tell_refused(&mut self, kind: RefusalKind, peer: String, refusal: Refusal) {
        let by = match refusal.by {
            RefusedBy::Here => "refused here",
            RefusedBy::Peer => "refused by the peer",
            RefusedBy::Network => "not reached",
        };
        let reason = format!("{by}: {}", refusal.reason);
        self.tell(ToControl::Refusal { kind, peer, what: refusal.name, reason });
    }

    /// Returns the next effect.
    pub(super) fn poll(&mut self) -> Option<Effect> {
        self.waiting.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use std::{io, sync::Mutex};

    use super::*;

    /// Returns the messages to the control plane.
    fn told(effects: &mut Effects) -> Vec<String> {
        let effects = std::iter::from_fn(|| effects.poll());
        let told = effects.map(|effect| match effect {
            Effect::Tell(ToControl::Lost { topic, cause, samples }) => {
                format!("{topic}: {samples} {cause}")
            }
            Effect::Tell(ToControl::Refusal { peer, what, reason, .. }) => {
                format!("{peer}, {what}: {reason}")
            }
            Effect::Tell(ToControl::Draining(draining)) => format!("draining: {draining}"),
            other => panic!("{other:?}"),
        });
        told.collect()
    }

    #[test]
    fn draining_is_told_when_it_changes() {
        let mut effects = Effects::default();
        [false, true, true, false].into_iter().for_each(|draining| effects.tell_draining(draining));
        assert_eq!(told(&mut effects), ["draining: true", "draining: false"]);
    }

    #[test]
    fn a_loss_is_told_once_however_it_came_about() {
        let mut effects = Effects::default();
        let unacknowledged = [("/t".into(), 2)];
        let counted = vec![TopicLoss { topic: "/t".into(), cause: "link_ended", samples: 2 }];
        effects.tell_link_over(DaemonId([1; 16]), "peer", &unacknowledged, counted);
        effects.tell_relays_given_up(vec![("/u".into(), 3)]);
        assert_eq!(told(&mut effects), ["/t: 2 link_ended", "/u: 3 link_ended"]);
    }

    /// A log in memory.
    #[derive(Clone, Default)]
    struct Sink(Arc<Mutex<Vec<u8>>>);

    impl io::Write for Sink {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_link_that_ends_and_relays_that_are_given_up_have_one_line_each() {
        let log = Sink::default();
        let sink = log.clone();
        let subscriber = tracing_subscriber::fmt().with_ansi(false);
        let subscriber = subscriber.with_writer(move || sink.clone());
        let names: Vec<_> = (10..60).map(|number| format!("/topic_{number}")).collect();
        tracing::subscriber::with_default(subscriber.finish(), || {
            let mut effects = Effects::default();
            let unacknowledged: Vec<_> = names.iter().map(|name| ((&**name).into(), 2)).collect();
            effects.tell_link_over(DaemonId([1; 16]), "peer", &unacknowledged, Vec::new());
            effects.tell_relays_given_up(names.iter().map(|name| (name.clone(), 3)).collect());
            effects.tell_link_over(DaemonId([1; 16]), "peer", &[], Vec::new());
            effects.tell_relays_given_up(Vec::new());
            assert_eq!(told(&mut effects).len(), 50);
        });
        let log = String::from_utf8(log.0.lock().unwrap().clone()).unwrap();
        let [over, given_up] = &log.lines().collect::<Vec<_>>()[..] else { panic!("{log}") };
        for (line, samples, others) in [(over, 100, 60), (given_up, 150, 90)] {
            assert_eq!(line.matches("/topic_").count(), 20, "{line}");
            assert!(line.contains(&format!("samples={samples}")), "{line}");
            assert!(line.contains(&format!("{others} of 30 other topics")), "{line}");
        }
    }

    #[test]
    fn a_route_that_stalls_is_a_refusal_and_a_loss() {
        let mut effects = Effects::default();
        let stalled = StalledRoute { topic: "/t".into(), reason: "why".into(), samples: 4 };
        effects.tell_stalled(RefusalKind::Peer, "peer".into(), stalled);
        assert_eq!(told(&mut effects), ["peer, topic /t: why", "/t: 4 stalled"]);
    }
}
