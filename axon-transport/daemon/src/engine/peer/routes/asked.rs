//! The routes that a peer was asked for.

use std::{
    collections::{BTreeMap, HashMap},
    rc::Rc,
    time::Duration,
};

use axon_envelope::{Kind, Route};
use axon_shm::ids::Gid;

use super::{
    WantedRoute, check_after,
    lanes::{self, LocalWriterCounts},
};
use crate::engine::route::RouteKey;
use crate::{
    engine::{
        account::{Charge, Meter},
        stand_in::StandIn,
    },
    link::{LastSeen, LinkMessage, Subscribe},
};

/// Longest wait for local readers to attach before the peer is asked for a route.
const ATTACH_TIMEOUT: Duration = Duration::from_secs(1);

/// A route that this host asked for.
pub(in crate::engine::peer) struct AskedRoute {
    pub(in crate::engine::peer) number: u32,
    pub(in crate::engine::peer) route: Route,
    /// The readers and writers that it was last asked for.
    pub(in crate::engine::peer) wanted: WantedRoute,
    /// True if a writer of it is not shown.
    pub(in crate::engine::peer) incomplete: bool,
    pub(in crate::engine::peer) stand_ins: HashMap<Gid, Rc<StandIn>>,
    /// Charge of one per stand-in, against the limit of writers that the route may show for the peer's identity.
    pub(in crate::engine::peer) places: Charge,
    /// Charge of one per stand-in and each writer here that it may read.
    pub(in crate::engine::peer) lanes: Charge,
    pub(in crate::engine::peer) room: Rc<Meter>,
}

/// A route whose local readers are not all attached.
struct PendingAttachment {
    until: Duration,
    /// Stand-ins, each with the number of readers that attach to it.
    awaited: Vec<(Rc<StandIn>, usize)>,
}

/// Stand-ins whose local readers are attached, and the routes to ask for because all their readers are attached.
#[derive(Default)]
pub(in crate::engine::peer) struct Attached {
    /// Stand-ins that samples may be written to, by the number of their route.
    pub(in crate::engine::peer) stand_ins: Vec<(u32, Vec<Rc<StandIn>>)>,
    /// Messages that ask for the routes.
    pub(in crate::engine::peer) messages: Vec<LinkMessage>,
}

impl AskedRoute {
    /// Keeps at most this number of its stand-ins. The others are opened again when there are lanes for them.
    fn keep_stand_ins(&mut self, number: usize) {
        let mut left = number;
        self.stand_ins.retain(|_, _| {
            left.checked_sub(1).is_some_and(|less| {
                left = less;
                true
            })
        });
        let gone = self.places.amount().saturating_sub(self.stand_ins.len());
        drop(self.places.split(gone));
        self.incomplete = true;
    }

    /// Returns the number of responses that its clients have not taken, and the number that found no room.
    pub(in crate::engine::peer) fn responses(&self) -> (u64, u64) {
        let clients = self.stand_ins.values();
        clients.fold((0, 0), |(waiting, refused), client| {
            let (ring, of) = (client.ring(), client.gid());
            (
                waiting + ring.calls_of(&of),
                refused.saturating_add(ring.refused_of(&of).unwrap_or(0)),
            )
        })
    }

    /// Returns the message that asks for the route.
    fn message(&self, key: &RouteKey) -> LinkMessage {
        let last = self.stand_ins.iter().filter_map(|(gid, stand_in)| {
            Some(LastSeen { publisher: *gid, sequence: stand_in.last_sequence()? })
        });
        LinkMessage::Subscribe(Subscribe {
            route: self.number,
            topic: key.topic.clone(),
            type_name: key.type_name.clone(),
            kind: key.kind as u8,
            subscribers: self.wanted.subscribers.clone(),
            last: last.collect(),
            acknowledges: Some(true),
            short_headers: Some(key.kind == Kind::Topic),
        })
    }
}

/// The routes that a peer was asked for, by key and by number.
pub(in crate::engine::peer) struct AskedRoutes {
    /// The most routes that the peer serves.
    most: usize,
    next_number: u32,
    routes: BTreeMap<RouteKey, AskedRoute>,
    keys: HashMap<u32, RouteKey>,
    /// Routes that the peer is asked for once their local readers are attached.
    attaching: BTreeMap<u32, PendingAttachment>,
    look_at_attaching: Option<Duration>,
}

impl AskedRoutes {
    /// Creates an empty list for a peer that serves at most this number of routes.
    pub(in crate::engine::peer) fn new(most: usize) -> Self {
        Self {
            most,
            next_number: 1,
            routes: BTreeMap::new(),
            keys: HashMap::new(),
            attaching: BTreeMap::new(),
            look_at_attaching: None,
        }
    }

    /// Returns the most routes that the peer serves.
    pub(in crate::engine::peer) fn most(&self) -> usize {
        self.most
    }

    /// Returns the route with this key.
    pub(in crate::engine::peer) fn get(&self, key: &RouteKey) -> Option<&AskedRoute> {
        self.routes.get(key)
    }

    /// Returns the key of the route with this number.
    pub(in crate::engine::peer) fn key_of(&self, number: u32) -> Option<&RouteKey> {
        self.keys.get(&number)
    }

    /// Returns all routes.
    pub(in crate::engine::peer) fn iter(&self) -> impl Iterator<Item = (&RouteKey, &AskedRoute)> {
        self.routes.iter()
    }

    /// Returns whether the peer serves this route too.
    pub(in crate::engine::peer) fn has_room_for(&self, key: &RouteKey) -> bool {
        self.routes.len() < self.most || self.routes.contains_key(key)
    }

    /// Returns a number that no route has had.
    pub(in crate::engine::peer) fn new_number(&mut self) -> u32 {
        self.next_number += 1;
        self.next_number - 1
    }

    /// Adds a route, in place of the one that [`take`](Self::take) removed.
    pub(in crate::engine::peer) fn insert(&mut self, key: RouteKey, asked: AskedRoute) {
        self.keys.insert(asked.number, key.clone());
        self.routes.insert(key, asked);
    }

    /// Removes a route so that it can be changed. The peer may still have to be asked for it.
    pub(in crate::engine::peer) fn take(&mut self, key: &RouteKey) -> Option<AskedRoute> {
        let asked = self.routes.remove(key)?;
        self.keys.remove(&asked.number);
        Some(asked)
    }

    /// Removes a route. Returns its number.
    pub(in crate::engine::peer) fn remove(&mut self, key: &RouteKey) -> Option<u32> {
        let asked = self.take(key)?;
        self.attaching.remove(&asked.number);
        Some(asked.number)
    }

    /// Returns the message that asks for a route.
    pub(in crate::engine::peer) fn message(&self, key: &RouteKey) -> Option<LinkMessage> {
        Some(self.routes.get(key)?.message(key))
    }

    /// Returns the messages that ask for all routes.
    pub(in crate::engine::peer) fn messages(&self) -> Vec<LinkMessage> {
        self.routes.iter().map(|(key, asked)| asked.message(key)).collect()
    }

    /// Schedules the request for a route: the peer is asked once the local readers of its stand-ins are attached.
    pub(in crate::engine::peer) fn ask_once_attached(
        &mut self,
        number: u32,
        awaited: Vec<(Rc<StandIn>, usize)>,
        now: Duration,
    ) {
        self.attaching.insert(number, PendingAttachment { until: now + ATTACH_TIMEOUT, awaited });
        self.look_at_attaching = Some(now);
    }

    /// Returns when [`take_attached`](Self::take_attached) is due.
    pub(in crate::engine::peer) fn poll_timeout(&self) -> Option<Duration> {
        self.look_at_attaching
    }

    /// Takes the stand-ins whose readers are attached by now, and the routes to ask for.
    pub(in crate::engine::peer) fn take_attached(&mut self, now: Duration) -> Attached {
        let mut attached = Attached::default();
        if self.look_at_attaching.is_none_or(|due| due > now) {
            return attached;
        }
        let mut complete = Vec::new();
        for (number, attaching) in &mut self.attaching {
            let late = now >= attaching.until;
            let is_ready = |(stand_in, readers): &mut (Rc<StandIn>, usize)| {
                late || stand_in.ring().partners().len() >= *readers
            };
            let ready: Vec<_> = attaching.awaited.extract_if(.., is_ready).collect();
            if !ready.is_empty() {
                attached.stand_ins.push((*number, ready.into_iter().map(|(s, _)| s).collect()));
            }
            if attaching.awaited.is_empty() {
                complete.push(*number);
            }
        }
        for number in complete {
            self.attaching.remove(&number);
            let message = self.keys.get(&number).and_then(|key| self.message(key));
            attached.messages.extend(message);
        }
        let waiting = self.attaching.len();
        self.look_at_attaching = (waiting > 0).then(|| now + check_after(waiting));
        attached
    }

    /// Gives up the stand-ins for which there are not enough lanes any more, after the writers of this host
    /// changed. Returns the routes that lost some.
    pub(in crate::engine::peer) fn fit_lanes(
        &mut self,
        writers: &LocalWriterCounts,
    ) -> Vec<RouteKey> {
        let mut shortened = Vec::new();
        for (key, asked) in &mut self.routes {
            let (each, had) = (writers.read_by_stand_in(key), asked.stand_ins.len());
            let fitting = lanes::fit(&mut asked.lanes, had, each);
            if fitting < had {
                asked.keep_stand_ins(fitting);
                shortened.push(key.clone());
            }
        }
        shortened
    }
}
