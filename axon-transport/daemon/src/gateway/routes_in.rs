//! The routes that this side asked a peer for, as its data streams find them.

use std::{
    collections::HashMap,
    sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard},
    time::Duration,
};

use axon_envelope::{Kind, Route};
use axon_shm::ids::Gid;
use tokio::sync::{Mutex, Notify};

use super::stand_in::StandIn;

/// How long a stream waits for its publisher: samples may be here before the graph that tells of it,
/// and the readers here have to be attached first.
const ARRIVAL: Duration = Duration::from_secs(2);

/// A route.
pub(super) struct RouteIn {
    /// The topic's name.
    pub(super) topic: Arc<str>,
    /// Topic and kind, for the envelope.
    pub(super) route: Route,
    /// What writes on the other side, once its readers here are attached.
    pub(super) writers: HashMap<Gid, Arc<StandIn>>,
    /// Of a route of responses: the clients here, and what the stream of each holds while it is read.
    pub(super) clients: HashMap<Gid, Arc<Mutex<()>>>,
}

/// The routes of a peer by this side's numbers for them.
#[derive(Default)]
pub(super) struct RoutesIn {
    routes: RwLock<HashMap<u32, RouteIn>>,
    changed: Notify,
}

impl RouteIn {
    pub(super) fn new(topic: Arc<str>, route: Route) -> Self {
        Self { topic, route, writers: HashMap::new(), clients: HashMap::new() }
    }
}

impl RoutesIn {
    /// Changes the routes, and has the streams look again that wait for one.
    pub(super) fn change<T>(&self, change: impl FnOnce(&mut HashMap<u32, RouteIn>) -> T) -> T {
        let changed = change(&mut self.write());
        self.changed.notify_waiters();
        changed
    }

    /// The route of a stream that says that it is of `gid`, and what it holds while it is read.
    pub(super) async fn stream(&self, number: u32, gid: Gid) -> Option<(Route, Arc<Mutex<()>>)> {
        self.find(number, |route| {
            let feeding = match route.route.kind {
                Kind::Response => route.clients.get(&gid),
                Kind::Topic | Kind::Request => route.writers.get(&gid).map(|w| &w.feeding),
            };
            Some((route.route, Arc::clone(feeding?)))
        })
        .await
    }

    /// The topic of a route that there is.
    pub(super) fn topic(&self, number: u32) -> Option<Arc<str>> {
        self.read().get(&number).map(|route| Arc::clone(&route.topic))
    }

    /// Who writes for `gid` here.
    pub(super) async fn writer(&self, number: u32, gid: Gid) -> Option<Arc<StandIn>> {
        self.find(number, |route| route.writers.get(&gid).cloned()).await
    }

    /// What stands for `gid` here, as far as a route is fed from it.
    pub(super) fn stand_in(&self, gid: &Gid) -> Option<Arc<StandIn>> {
        self.read().values().find_map(|route| route.writers.get(gid).cloned())
    }

    /// Looks, for a while, as long as there is such a route.
    async fn find<T>(&self, number: u32, look: impl Fn(&RouteIn) -> Option<T>) -> Option<T> {
        // Almost always it is there, and then nothing else is needed.
        match self.read().get(&number).map(&look) {
            Some(None) => {}
            Some(found) => return found,
            None => return None,
        }
        let found = async {
            loop {
                let changed = self.changed.notified();
                tokio::pin!(changed);
                // Registered before the look, so that no change in between is missed.
                changed.as_mut().enable();
                match self.read().get(&number).map(&look) {
                    Some(None) => {}
                    Some(found) => return found,
                    None => return None,
                }
                changed.await;
            }
        };
        tokio::time::timeout(ARRIVAL, found).await.ok().flatten()
    }

    fn read(&self) -> RwLockReadGuard<'_, HashMap<u32, RouteIn>> {
        self.routes.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, HashMap<u32, RouteIn>> {
        self.routes.write().unwrap_or_else(PoisonError::into_inner)
    }
}
