//! Calls that outlive a connection: the daemon's process may have ended and taken requests and responses with it.
//!
//! The stand-ins of clients and servers on this host stay for a while, though no endpoint counts them. When the next
//! daemon matches them again, the session sends the unanswered requests and the servers' unconfirmed responses once
//! more. A server drops a request that it had, and a client's process drops a response that it had.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::{
    RelayConnection,
    relays::{ABSENCE, drop_overdue},
    stand_ins::{KeptCalls, LeftByConnection, SessionStandIn},
};
use crate::{
    graph::EndpointKind,
    ids::{DaemonId, Gid},
    session::relayed::unanswered::Unanswered,
};

impl LeftByConnection {
    /// Removes the relays and calls that waited for too long while there is no daemon.
    pub(super) fn drop_overdue(&mut self) {
        drop_overdue(&mut self.relays);
        let KeptCalls { stand_ins, unanswered, .. } = &mut self.calls;
        forget_overdue(stand_ins, unanswered);
    }
}

impl KeptCalls {
    /// Returns the calls that a connection to this daemon continues. A daemon that lives on has told the other ends
    /// that this session had ended: calls in flight are lost, and the clients see their servers go.
    pub(super) fn for_daemon(self, daemon: DaemonId) -> Self {
        if self.daemon == Some(daemon) {
            Self { response_log: self.response_log, ..Self::default() }
        } else {
            self
        }
    }
}

/// Removes the stand-ins that waited for too long: the clients see these servers go.
fn forget_overdue(stand_ins: &mut BTreeMap<Gid, SessionStandIn>, unanswered: &mut Unanswered) {
    let now = Instant::now();
    let overdue: Vec<Gid> =
        stand_ins.iter().filter(|(_, one)| one.is_overdue(now)).map(|(gid, _)| *gid).collect();
    for server in overdue {
        let Some(stand_in) = stand_ins.remove(&server) else { continue };
        let requests = unanswered.forget_server(&server);
        if requests > 0 {
            let topic = &stand_in.remote_writer().endpoint().topic;
            tracing::warn!(
                topic, %server, requests,
                "gave up calls: no daemon reached their server within {ABSENCE:?} after the last one ended"
            );
        }
    }
}

impl RelayConnection<'_> {
    /// Returns the calls that outlive the connection.
    pub(super) fn keep_calls(&mut self) -> KeptCalls {
        let until = Instant::now() + ABSENCE;
        let mut stand_ins = std::mem::take(&mut self.stand_ins);
        let mut unanswered = std::mem::take(&mut self.unanswered);
        stand_ins.retain(|gid, stand_in| {
            let kind = stand_in.remote_writer().endpoint().kind;
            // A host that is reached through the daemon learns that the daemon has ended, and gives up the calls in
            // flight.
            let near = self.world.get(gid).is_some_and(|(daemon, _)| *daemon == self.daemon);
            let kept = matches!(kind, EndpointKind::Client | EndpointKind::Server)
                && (near || stand_in.is_kept());
            if kept {
                stand_in.keep(until);
                stand_in.remote_writer().take_back();
            } else {
                unanswered.forget_server(gid);
            }
            kept
        });
        let unkept = unanswered.take_unkept();
        if unkept > 0 {
            tracing::warn!(requests = unkept, "too many calls were under way to be sent again");
        }
        KeptCalls {
            daemon: Some(self.daemon),
            stand_ins,
            calls: std::mem::take(&mut self.calls),
            unanswered,
            response_log: self.pipe.response_log.take().unwrap_or_default(),
        }
    }

    /// Removes the stand-ins that waited for too long.
    pub(super) fn forget_overdue(&mut self) {
        forget_overdue(&mut self.stand_ins, &mut self.unanswered);
    }

    /// Returns how long the first kept stand-in still waits.
    pub(super) fn kept_for(&self) -> Option<Duration> {
        let until = self.stand_ins.values().filter_map(SessionStandIn::kept_until).min()?;
        Some(until.saturating_duration_since(Instant::now()))
    }
}
