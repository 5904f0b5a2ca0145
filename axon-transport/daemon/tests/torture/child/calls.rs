//! Calls the service of every process, and answers the calls of every process.

use std::{
    collections::{HashMap, VecDeque},
    sync::{Mutex, atomic::Ordering},
    time::{Duration, Instant},
};

use axon_transport::{Client, Server, ids::Gid};

use super::{Child, Kind, PATIENCE, hex, publishing::is_for_now, stamp};
use crate::sample::{Random, fill, is_whole};

/// Maximum number of calls that a server has not answered yet.
const IN_FLIGHT: usize = 8;
/// Maximum time between two calls in milliseconds.
const PAUSE_MS: u64 = 200;
/// Maximum length of a request, as a power of two.
const LONGEST_POWER: u64 = 18;

/// The calls that servers have not answered.
#[derive(Default)]
pub(super) struct Calls {
    /// The calls by server. A server that existed when a call was sent has to answer it.
    due: Mutex<HashMap<Gid, VecDeque<u64>>>,
}

impl Child {
    /// Sends calls, and takes the responses.
    pub(super) fn call_all(&self, client: &Client, random: &mut Random) {
        let (mut number, mut next) = (0, Instant::now());
        let mut last = HashMap::new();
        let mut bytes = Vec::new();
        while !self.over.load(Ordering::Relaxed) {
            let ready = || client.has_response() || self.over.load(Ordering::Relaxed);
            self.session.wait(ready, Some(Duration::from_millis(20)));
            while let Some(info) = client.take_response(&mut bytes) {
                let (server, call) = (info.publisher, info.sequence);
                let pattern = stamp(server) ^ stamp(client.gid());
                assert!(is_whole(pattern, call, 0, &bytes), "{info:?}");
                let before = last.insert(server, call);
                assert!(before < Some(call), "{info:?} after {before:?}: answered twice");
                assert!(call <= number, "{info:?}: no such call");
                let mut missed = 0;
                let mut due = self.calls.due.lock().expect("no panic");
                let due = due.entry(server).or_default();
                while due.front().is_some_and(|front| *front <= call) {
                    missed += u64::from(due.pop_front() != Some(call));
                }
                if missed > 0 && !server.is_of(&self.session.id()) {
                    self.missed(Kind::Response, &info, missed);
                }
                self.answers.fetch_add(1, Ordering::Relaxed);
            }
            if Instant::now() < next || self.quiet.load(Ordering::Relaxed) {
                continue;
            }
            let servers = client.servers();
            if self.unanswered(&servers) >= IN_FLIGHT {
                continue;
            }
            let mut request = vec![0; length(random)];
            fill(stamp(client.gid()), number + 1, &mut request);
            // A response may arrive before `send_request` returns.
            match client.send_request(&request) {
                Ok(sent) => {
                    number += 1;
                    assert_eq!(sent, number, "numbers rise by one");
                    let mut due = self.calls.due.lock().expect("no panic");
                    for server in servers {
                        due.entry(server).or_default().push_back(number);
                    }
                    next = Instant::now() + Duration::from_millis(random.below(PAUSE_MS));
                }
                Err(error) => assert!(is_for_now(&error), "{error}"),
            }
        }
    }

    /// Returns the largest number of unanswered calls of any of these servers.
    fn unanswered(&self, servers: &[Gid]) -> usize {
        let due = self.calls.due.lock().expect("no panic");
        servers.iter().filter_map(|server| due.get(server)).map(VecDeque::len).max().unwrap_or(0)
    }

    /// Waits until every existing server has answered, and records the calls that servers which are gone did not
    /// answer. Returns the first server that does not answer, if any.
    pub(super) fn finish_calls(&self, client: &Client) -> Option<Gid> {
        let silent = || {
            let servers = client.servers();
            servers.into_iter().find(|server| self.unanswered(&[*server]) > 0)
        };
        if !self.session.wait(|| silent().is_none(), Some(PATIENCE)) {
            return silent();
        }
        let due = std::mem::take(&mut *self.calls.due.lock().expect("no panic"));
        for (server, calls) in due.into_iter().filter(|(_, calls)| !calls.is_empty()) {
            self.note(Kind::Unanswered, server, calls.len() as u64);
            self.pair_log.add(&format!("{}: {calls:?} not answered", hex(server)));
        }
        None
    }

    /// Answers every request once.
    pub(super) fn answer_all(&self, server: &Server) {
        let mut last = HashMap::new();
        let (mut request, mut response) = (Vec::new(), Vec::new());
        while !self.over.load(Ordering::Relaxed) {
            let ready = || server.has_request() || self.over.load(Ordering::Relaxed);
            self.session.wait(ready, Some(Duration::from_millis(50)));
            let Some(info) = server.take_request(&mut request) else { continue };
            let (client, call) = (info.publisher, info.sequence);
            assert!(is_whole(stamp(client), call, 0, &request), "{info:?}");
            if let Some(before) = last.insert(client, call) {
                assert!(call > before, "{info:?} after {before}: seen twice");
                if call > before + 1 && !client.is_of(&self.session.id()) {
                    self.missed(Kind::Request, &info, call - before - 1);
                }
            }
            response.resize(request.len(), 0);
            fill(stamp(client) ^ stamp(server.gid()), call, &mut response);
            while let Err(error) = server.send_response(client, call, &response) {
                assert!(is_for_now(&error), "{error}");
                if self.over.load(Ordering::Relaxed) || !server.clients().contains(&client) {
                    break;
                }
            }
        }
    }
}

/// Returns a length; each power of two is equally likely.
fn length(random: &mut Random) -> usize {
    let most = 1_u64 << random.below(LONGEST_POWER);
    usize::try_from(random.below(most + 1)).expect("at most some hundred thousand")
}
