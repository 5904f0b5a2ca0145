//! Routes that this side asks for, and the stand-ins that they feed.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    sync::Arc,
    time::Duration,
};

use axon_envelope::{Kind, Route, TopicHash};
use axon_shm::ids::Gid;
use axon_transport::graph::{Endpoint, EndpointKind};

use super::{
    MAX_ROUTES, OnDrop, POLL, Peer,
    refused::{TOO_MANY_ASKED, TOO_MANY_WRITERS},
};
use crate::{
    gateway::{
        control::Outbox,
        hub::{Local, Shared},
        routes::{self, RouteKey, Wanted},
        routes_in::{RouteIn, RoutesIn},
        stand_in::StandIn,
    },
    link::{LastSeen, Message, Subscribe, Subscriber, Unsubscribe},
};

/// A route is asked for when its stand-ins have their local readers, or after this at the latest.
const ATTACH_TIMEOUT: Duration = Duration::from_secs(1);

/// A route that this side asked for.
pub(super) struct Asked {
    pub(super) number: u32,
    subscribers: Vec<Subscriber>,
    pub(super) stand_ins: HashMap<Gid, Arc<StandIn>>,
    /// Sends SUBSCRIBE once the stand-ins have their readers.
    asking: Option<OnDrop>,
}

impl Asked {
    /// The SUBSCRIBE that asks for it.
    pub(super) fn message(&self, key: &RouteKey) -> Message {
        let last = self
            .stand_ins
            .iter()
            .filter_map(|(gid, s)| Some(LastSeen { publisher: *gid, sequence: s.last_sequence()? }))
            .collect();
        Message::Subscribe(Subscribe {
            route: self.number,
            topic: key.topic.clone(),
            type_name: key.type_name.clone(),
            kind: key.kind as u8,
            subscribers: self.subscribers.clone(),
            last,
            acknowledges: Some(key.kind == Kind::Topic),
        })
    }
}

impl Peer {
    /// Brings routes and stand-ins in line with what there is here and there.
    pub(in crate::gateway) fn update(&mut self, local: &Local, shared: &Arc<Shared>) {
        // What it announced since was not compared with what others announce: that comes with its turn.
        if self.stirred {
            return;
        }
        let publishers =
            local.values().map(|(e, _)| e).filter(|e| e.kind == EndpointKind::Publisher);
        self.alive.watch(publishers.filter_map(|e| e.qos.lease));
        // A server there is shown once its host asks for requests: then it has what answers them.
        self.answering = self.now_answering();
        let reachable = self.remote.endpoints().filter(|remote| {
            let e = &remote.endpoint;
            e.kind != EndpointKind::Server || self.answering.contains(&e.gid)
        });
        let own = local.values().map(|(endpoint, reach)| (&**endpoint, reach.toward(self.daemon)));
        let wanted = routes::wanted(own, reachable);
        self.want(wanted, shared);
        self.feed_services();
    }

    /// As [`update`](Self::update), where servers there have become reachable or are so no more.
    pub(in crate::gateway) fn update_services(&mut self, local: &Local, shared: &Arc<Shared>) {
        if self.answering != self.now_answering() {
            self.update(local, shared);
        }
    }

    fn now_answering(&self) -> BTreeSet<Gid> {
        let requests = self.served.values().filter(|served| served.key.kind == Kind::Request);
        requests.flat_map(|served| served.subscribers.iter().copied()).collect()
    }

    fn want(&mut self, wanted: BTreeMap<RouteKey, Wanted>, shared: &Arc<Shared>) {
        let gone: Vec<_> = self.asked.keys().filter(|k| !wanted.contains_key(k)).cloned().collect();
        self.refused.unasked.retain(|key, _| wanted.contains_key(key));
        let room_there = gone.len();
        for key in gone {
            self.refused.settle(&key);
            if let Some(asked) = self.asked.remove(&key) {
                self.routes_in.change(|routes| drop(routes.remove(&asked.number)));
                self.say(Message::Unsubscribe(Unsubscribe { route: asked.number }));
            }
        }
        for (key, wanted) in wanted {
            if self.asked.len() >= MAX_ROUTES && !self.asked.contains_key(&key) {
                self.refused.unasked(&key, TOO_MANY_ASKED);
                continue;
            }
            self.refused.unasked.remove(&key);
            self.want_one(key, wanted, shared);
        }
        if room_there > 0 {
            self.ask_instead(room_there);
        }
    }

    fn want_one(&mut self, key: RouteKey, wanted: Wanted, shared: &Arc<Shared>) {
        let hash = TopicHash::new(shared.domain, &key.topic, &key.type_name);
        let Ok(topic) = hash else { return };
        let mut asked = self.asked.remove(&key).unwrap_or_else(|| {
            self.next_route += 1;
            Asked {
                number: self.next_route - 1,
                subscribers: Vec::new(),
                stand_ins: HashMap::new(),
                asking: None,
            }
        });
        let writers: HashSet<_> = wanted.writers.iter().map(|(writer, _)| writer.gid).collect();
        asked.stand_ins.retain(|gid, _| writers.contains(gid));
        let fresh = self.show(&key, &mut asked, &wanted.writers, shared);
        if asked.stand_ins.is_empty() && asked.subscribers.is_empty() {
            // Nobody here would take what comes.
            return;
        }
        let changed = asked.subscribers != wanted.subscribers || fresh;
        asked.subscribers = wanted.subscribers;
        let route = Route { kind: key.kind, topic };
        self.routes_in.change(|routes| {
            let new = || RouteIn::new(key.topic.as_str().into(), route);
            let route = routes.entry(asked.number).or_insert_with(new);
            route.writers.retain(|gid, _| asked.stand_ins.contains_key(gid));
            if key.kind == Kind::Response {
                let clients: HashSet<_> =
                    asked.subscribers.iter().map(|client| client.gid).collect();
                route.clients.retain(|gid, _| clients.contains(gid));
                for gid in clients {
                    route.clients.entry(gid).or_default();
                }
            }
        });
        if changed {
            let awaited = wanted.writers.iter().filter_map(|(writer, readers)| {
                Some((Arc::clone(asked.stand_ins.get(&writer.gid)?), *readers))
            });
            let attend = attend(
                Arc::clone(&self.routes_in),
                asked.number,
                awaited.collect(),
                self.outbox.clone(),
                asked.message(&key),
            );
            asked.asking = Some(OnDrop(tokio::spawn(attend)));
        }
        self.asked.insert(key, asked);
    }

    /// Makes the stand-ins that a route lacks. Whether there are new ones.
    fn show(
        &mut self,
        key: &RouteKey,
        asked: &mut Asked,
        writers: &[(Endpoint, usize)],
        shared: &Arc<Shared>,
    ) -> bool {
        let mut fresh = false;
        for (writer, _) in writers {
            let gid = writer.gid;
            if asked.stand_ins.contains_key(&gid) {
                continue;
            }
            match shared.stand_ins.get(&shared.session, writer, self.remote.account()) {
                Ok(Some(stand_in)) => {
                    asked.stand_ins.insert(gid, stand_in);
                    fresh = true;
                }
                Ok(None) => {
                    self.refused.unasked(key, TOO_MANY_WRITERS);
                    break;
                }
                Err(error) => {
                    tracing::error!(topic = key.topic, %error, "a remote publisher is not shown");
                }
            }
        }
        fresh
    }
}

/// Lets samples in to each stand-in when it has its readers, as they would find nobody before, and
/// then asks for more of them.
async fn attend(
    routes: Arc<RoutesIn>,
    number: u32,
    mut awaited: Vec<(Arc<StandIn>, usize)>,
    outbox: Outbox,
    message: Message,
) {
    let until = tokio::time::Instant::now() + ATTACH_TIMEOUT;
    loop {
        let late = tokio::time::Instant::now() >= until;
        let ready = |(stand_in, readers): &mut (Arc<StandIn>, usize)| {
            late || stand_in.partners().len() >= *readers
        };
        let ready: Vec<_> = awaited.extract_if(.., ready).collect();
        if !ready.is_empty() {
            routes.change(|routes| {
                if let Some(route) = routes.get_mut(&number) {
                    route.writers.extend(ready.into_iter().map(|(s, _)| (s.gid(), s)));
                }
            });
        }
        if awaited.is_empty() {
            return outbox.send(message);
        }
        tokio::time::sleep(POLL).await;
    }
}
