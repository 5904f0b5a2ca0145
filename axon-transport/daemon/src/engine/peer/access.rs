//! The rights that access rules give a peer on this host, and the denied uses that both hosts know of.

use std::{
    collections::{BTreeMap, BTreeSet},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    access::{Permissions, Verb},
    graph::{Endpoint, EndpointKind},
    internal::{
        graph::{other_end, verb_of},
        log_limit::LogLimit,
        wire::session::CheckedUse,
    },
    status::{LinkStatus, PeerDecision},
};

use super::{
    rights::{EndpointRights, RightsByEndpoint},
    routes::refused::shown,
};
use crate::{
    bridge::RefusedRoute,
    engine::{
        account::{Account, Charge, Meter},
        peer_graph::decisions::note_look,
    },
    link::{
        AccessDecisions, DeniedUse, DeniedUses, LinkAccessCheck, LinkMessage, MAX_DENIED,
        UseDecision,
    },
};

/// The most denied uses that status lists.
const LISTED: usize = 64;
/// The most denied uses that status shows at the endpoints that wait for them.
const AT_ENDPOINTS: usize = 1024;
/// Bytes that a denied use counts in addition to its name and reason.
const ENTRY: usize = 200;
/// The most questions that wait for the peer's answer. Beyond that the oldest is given up.
const UNANSWERED: usize = 64;

/// A use of a topic or service: a verb and the name.
pub(super) type AccessUse = (Verb, String);

/// The verbs that need an endpoint, as DENIED numbers them.
const VERBS: [Verb; 4] = [Verb::Publish, Verb::Subscribe, Verb::Serve, Verb::Call];

/// All verbs, as ACCESS_CHECK numbers them.
const CHECKED: [Verb; 5] = Verb::ALL;

/// Returns the kind of endpoint that a verb needs.
fn kind_of(verb: Verb) -> EndpointKind {
    match verb {
        Verb::Publish => EndpointKind::Publisher,
        Verb::Subscribe => EndpointKind::Subscription,
        Verb::Serve => EndpointKind::Server,
        Verb::Call => EndpointKind::Client,
        Verb::See => EndpointKind::Node,
    }
}

/// The access rules for one peer.
pub(super) struct PeerAccess {
    permissions: Permissions,
    /// True if the rules changed since the denied uses were judged.
    changed: bool,
    rights: RightsByEndpoint,
    /// Denied uses by the peer's endpoints on this host, each with its reason and its charge. The peer was
    /// informed of them.
    here: BTreeMap<AccessUse, (String, Charge)>,
    /// Uses by this host's endpoints that the peer's host denies, each with its reason and its charge.
    there: BTreeMap<AccessUse, (String, Charge)>,
    /// Bounds on `there` and on `here`, for all daemon IDs of the peer's identity.
    room: Rc<Meter>,
    places: Rc<Meter>,
    /// The questions that the peer has not answered: the number of each, and how many uses it is about.
    asked: BTreeMap<u64, usize>,
    logged: LogLimit,
}

impl PeerAccess {
    pub(super) fn new(permissions: Permissions, account: &Account) -> Self {
        let (here, there) = (BTreeMap::new(), BTreeMap::new());
        let (room, places) = (Rc::clone(&account.refusals), Rc::clone(&account.denied));
        let asked = BTreeMap::new();
        let (rights, logged) = (RightsByEndpoint::default(), LogLimit::default());
        Self { permissions, changed: false, rights, here, there, room, places, asked, logged }
    }

    pub(super) fn permissions(&self) -> &Permissions {
        note_look();
        &self.permissions
    }

    pub(super) fn set_permissions(&mut self, permissions: Permissions) {
        self.permissions = permissions;
        self.changed = true;
        self.rights.clear();
    }

    /// Returns whether the peer may see and use an endpoint of this host.
    pub(super) fn judge(&mut self, endpoint: &Arc<Endpoint>) -> EndpointRights {
        self.rights.judge(&self.permissions, endpoint)
    }

    /// Forgets endpoints of this host that are gone.
    pub(super) fn retain_rights(&mut self, stands: impl Fn(&Gid) -> bool) {
        self.rights.retain(stands);
    }

    /// Returns why the peer may not make this use; `None` if it may.
    pub(super) fn denial(&self, verb: Verb, name: &str) -> Option<String> {
        note_look();
        if self.permissions.are_unrestricted() {
            return None;
        }
        let decision = self.permissions.check(verb, name);
        (!decision.allowed()).then(|| decision.to_string())
    }

    /// Updates the denied endpoints of the peer. Returns the messages for the peer. The rules are evaluated
    /// for new uses, and for all uses after the rules changed.
    pub(super) fn set_denied<'a>(
        &mut self,
        peer: DaemonId,
        endpoints: impl Iterator<Item = &'a Endpoint>,
        now: Duration,
    ) -> Vec<LinkMessage> {
        let uses = endpoints.filter_map(|e| Some((verb_of(e.kind)?, e.topic.as_str())));
        // Uses that the peer was informed of stay: a use that is not repeated would count as allowed.
        let told: BTreeSet<_> =
            self.here.keys().map(|(verb, name)| (*verb, name.as_str())).collect();
        let (mut known, mut new) = (BTreeSet::new(), BTreeSet::new());
        for used in uses {
            if told.contains(&used) {
                known.insert(used);
            } else if new.len() < self.places.most() {
                new.insert(used);
            }
        }
        let lifted: Vec<AccessUse> = {
            let gone = |(verb, name): &&AccessUse| !known.contains(&(*verb, name.as_str()));
            self.here.keys().filter(gone).cloned().collect()
        };
        let anew = std::mem::take(&mut self.changed).then_some(known).into_iter().flatten();
        let rights: Vec<AccessUse> =
            anew.chain(new).map(|(verb, name)| (verb, name.to_owned())).collect();
        // Removed uses make room for new ones.
        lifted.iter().for_each(|used| drop(self.here.remove(used)));
        let mut denied = Vec::new();
        for used in rights {
            let mut place = None;
            if !self.here.contains_key(&used) {
                // Uses without a place are not judged. Otherwise a peer with many of them would have the
                // rules evaluated at each change of its graph.
                place = self.places.charge(1);
                if place.is_none() {
                    continue;
                }
            }
            note_look();
            let reason = self.permissions.check(used.0, &used.1).to_string();
            match self.here.get_mut(&used) {
                Some((before, _)) if *before == reason => continue,
                Some((before, _)) => before.clone_from(&reason),
                None => {
                    self.here.extend(place.map(|place| (used.clone(), (reason.clone(), place))))
                }
            }
            denied.push(message(&used, &reason));
        }
        if let Some(first) = denied.first()
            && let Some(uses) = self.logged.count(now)
        {
            let (verb, name) = (VERBS[usize::from(first.verb)].name(), &first.name);
            tracing::warn!(%peer, verb, name, why = first.reason, uses,
                "a peer's endpoints are denied by access rules; `axon status` names them");
        }
        parts(denied, lifted.iter().map(|used| message(used, "")).collect())
    }

    /// Moves to a new connection: both sides repeat their denied uses, because some messages may not have
    /// arrived.
    pub(super) fn succeed(&mut self) -> Vec<LinkMessage> {
        self.there.clear();
        parts(self.here.iter().map(|(used, (why, _))| message(used, why)).collect(), Vec::new())
    }

    /// Handles the peer's report about uses that its host denies. Returns the uses that are no longer denied.
    pub(super) fn handle_denied(
        &mut self,
        now: Duration,
        peer: DaemonId,
        denied: DeniedUses,
    ) -> Vec<AccessUse> {
        let used = |of: DeniedUse| (VERBS[usize::from(of.verb.min(3))], of.name);
        for mut denied in denied.denied {
            let reason = shown(&std::mem::take(&mut denied.reason));
            let used = used(denied);
            if let Some(uses) = self.logged.count(now) {
                let (verb, name) = (used.0.name(), &used.1);
                tracing::warn!(%peer, verb, name, why = reason, uses,
                    "access rules of a peer deny endpoints of this host; `axon status` names them");
            }
            self.there.remove(&used);
            let charge = self.room.charge(ENTRY + used.1.len() + reason.len());
            self.there.extend(charge.map(|charge| (used, (reason, charge))));
        }
        let lifted = denied.lifted.into_iter().map(used);
        lifted.filter(|used| self.there.remove(used).is_some()).collect()
    }

    /// Answers which uses the peer may make here. The peer could learn the same by announcing such endpoints,
    /// because DENIED reports them.
    pub(super) fn answer(&self, check: &LinkAccessCheck) -> LinkMessage {
        let decisions = check.uses.iter().map(|used| {
            let decision =
                self.permissions.check(CHECKED[usize::from(used.verb.min(4))], &used.name);
            UseDecision { allowed: decision.allowed(), reason: decision.to_string() }
        });
        let decisions = decisions.collect();
        LinkMessage::AccessDecisions(AccessDecisions { number: check.number, decisions })
    }

    /// Asks the peer which uses it permits to this host.
    pub(super) fn ask(&mut self, number: u64, uses: Vec<CheckedUse>) -> LinkMessage {
        while self.asked.len() >= UNANSWERED {
            self.asked.pop_first();
        }
        self.asked.insert(number, uses.len());
        LinkMessage::AccessCheck(LinkAccessCheck { number, uses })
    }

    /// Returns the peer's answer if this host asked the question. Each question has one answer.
    pub(super) fn take_decisions(&mut self, answer: AccessDecisions) -> Option<Vec<PeerDecision>> {
        let uses = self.asked.remove(&answer.number)?;
        let decisions = answer.decisions.into_iter();
        let decisions: Vec<_> =
            decisions.map(|of| PeerDecision::new(of.allowed, shown(&of.reason))).collect();
        (decisions.len() == uses).then_some(decisions)
    }

    /// Returns each denied use, the host that denies it, and the reason.
    fn all(&self) -> impl Iterator<Item = (&AccessUse, &'static str, &str)> {
        let there = self.there.iter().map(|(used, (why, _))| (used, "by the peer", &**why));
        there.chain(self.here.iter().map(|(used, (why, _))| (used, "here", &**why)))
    }

    /// Adds the denied uses to the link's status.
    pub(super) fn fill(&self, status: &mut LinkStatus) {
        for ((verb, name), by, why) in self.all().take(LISTED) {
            let whose = if by == "here" { "the peer's" } else { "ours" };
            status.denied.insert(format!("{verb} {name} ({whose})"), format!("{by}: {why}"));
        }
        status.more_denied = (self.here.len() + self.there.len()).saturating_sub(LISTED);
    }

    /// Returns the denied uses for the status of this host's waiting endpoints.
    pub(super) fn refused_routes(&self) -> Vec<RefusedRoute> {
        let all = self.all().take(AT_ENDPOINTS).map(|((verb, name), by, why)| RefusedRoute {
            topic: name.clone(),
            type_name: None,
            waits: kind_of(if by == "here" { other_end(*verb) } else { *verb }),
            reason: format!("{by}: {why}"),
        });
        all.collect()
    }
}

fn message((verb, name): &AccessUse, reason: &str) -> DeniedUse {
    let number = VERBS.iter().position(|known| known == verb).unwrap_or_default();
    DeniedUse { verb: number as u8, name: name.clone(), reason: reason.to_owned() }
}

fn parts(denied: Vec<DeniedUse>, lifted: Vec<DeniedUse>) -> Vec<LinkMessage> {
    let part = |denied: &[DeniedUse], lifted: &[DeniedUse]| {
        LinkMessage::Denied(DeniedUses { denied: denied.to_vec(), lifted: lifted.to_vec() })
    };
    let lifted = lifted.chunks(MAX_DENIED).map(|lifted| part(&[], lifted));
    lifted.chain(denied.chunks(MAX_DENIED).map(|denied| part(denied, &[]))).collect()
}

#[cfg(test)]
mod tests {
    use axon_transport::access::{AccessRules, Principal};

    use super::*;
    use crate::engine::account::Accounts;

    fn publishers(names: std::ops::Range<u32>) -> Vec<Endpoint> {
        let of = |n| Endpoint::new(Gid::default(), EndpointKind::Publisher, format!("/{n}"), "T");
        names.map(of).collect()
    }

    fn said(messages: &[LinkMessage]) -> (usize, usize) {
        messages.iter().fold((0, 0), |(denied, lifted), message| match message {
            LinkMessage::Denied(uses) => (denied + uses.denied.len(), lifted + uses.lifted.len()),
            other => panic!("{other:?}"),
        })
    }

    #[test]
    fn denied_uses_are_bounded_over_all_daemons_of_an_identity() {
        let rules = AccessRules::parse("default = \"deny\"", "access.toml").unwrap();
        let permissions = rules.permissions(Principal::Address("10.0.0.1".parse().unwrap()));
        let account = Accounts::new(1 << 20, 1 << 20).of_one("a");
        let [mut one, mut other] = [(); 2].map(|()| PeerAccess::new(permissions.clone(), &account));
        let daemons = [DaemonId([1; 16]), DaemonId([2; 16])];
        let set = |access: &mut PeerAccess, daemon, names| {
            said(&access.set_denied(daemon, publishers(names).iter(), Duration::ZERO))
        };
        assert_eq!(set(&mut one, daemons[0], 0..700), (700, 0));
        assert_eq!(set(&mut other, daemons[1], 0..700), (324, 0));
        assert_eq!(set(&mut one, daemons[0], 0..700), (0, 0), "it was told");
        // One peer may use the places that the other one leaves, in the same step too.
        assert_eq!(set(&mut one, daemons[0], 650..800), (100, 650));
        assert_eq!(set(&mut other, daemons[1], 0..700), (376, 0));
        drop(one);
        assert_eq!(account.denied.held(), 700);
    }
}
