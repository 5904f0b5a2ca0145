//! What access rules let other users of this host do.
//!
//! The sessions of the daemon's own user are not restricted: whoever has that user's rights can do anything to them.

#[cfg(test)]
mod tests;

use std::collections::HashMap;

use super::Registry;
use crate::{
    access::{AccessRules, Party, Permissions},
    graph::{Endpoint, permits, shows, verb_of},
    ids::{Gid, SessionId},
    wire::session::{EndpointRole, Refused},
};

/// The rules, compiled for each user who has a session, or had one.
#[derive(Debug, Default)]
pub(super) struct Users {
    rules: AccessRules,
    permissions: HashMap<u32, Permissions>,
}

impl Users {
    pub(super) fn have_rules(&self) -> bool {
        !self.rules.is_empty()
    }

    fn add(&mut self, user: u32) {
        let rules = &self.rules;
        self.permissions.entry(user).or_insert_with(|| rules.permissions(Party::User(user)));
    }

    fn set_rules(&mut self, rules: AccessRules) {
        for (user, permissions) in &mut self.permissions {
            *permissions = rules.permissions(Party::User(*user));
        }
        self.rules = rules;
    }

    /// Why a user may not have an endpoint, if it may not.
    fn denial(&self, user: Option<u32>, endpoint: &Endpoint) -> Option<String> {
        let permissions = self.permissions.get(&user?)?;
        let verb = verb_of(endpoint.kind)?;
        let denied = !permits(permissions, endpoint);
        denied.then(|| permissions.check(verb, &endpoint.topic).to_string())
    }

    /// Whether `user` is shown an endpoint of a session of user `of`.
    pub(super) fn shows(&self, user: Option<u32>, of: Option<u32>, endpoint: &Endpoint) -> bool {
        let permissions = user.and_then(|user| self.permissions.get(&user));
        user == of || permissions.is_none_or(|permissions| shows(permissions, endpoint))
    }
}

impl<F: Clone> Registry<F> {
    /// A session is of another user than the daemon's. Has to be called before it has endpoints.
    pub fn set_user(&mut self, id: &SessionId, user: u32) {
        self.users.add(user);
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.user = Some(user);
        }
    }

    /// These access rules count from now on. Pairs that they do not allow end, and those that they allow are made.
    pub fn set_access(&mut self, rules: AccessRules) {
        self.users.set_rules(rules);
        let of_users = self.sessions.iter().filter(|(_, entry)| entry.user.is_some());
        let of_users: Vec<_> = of_users.map(|(id, entry)| (*id, entry.endpoints.clone())).collect();
        for (id, endpoints) in of_users {
            self.sessions.request_resync(&id);
            if let Some(entry) = self.sessions.get_mut(&id) {
                entry.refused = false;
            }
            endpoints.iter().for_each(|gid| self.judge(&id, gid));
        }
    }

    /// Judges an endpoint anew.
    fn judge(&mut self, id: &SessionId, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        let (endpoint, role, was_shown) = (local.endpoint.clone(), local.role, local.is_shown());
        let denial = self.denial(id, role, &endpoint);
        if !self.endpoints.set_denied(gid, denial.is_some()) {
            return;
        }
        if let Some(why) = denial {
            self.note_denied(id, &endpoint, &why);
        }
        match (was_shown, self.endpoints.get(gid).is_some_and(|local| local.is_shown())) {
            (true, false) => self.changes.remove(*gid, true),
            (false, true) => self.graph_add_local(&endpoint),
            _ => {}
        }
        self.rematch(gid);
    }

    /// Why access rules deny an endpoint to its user, if they do.
    pub(super) fn denial(
        &self,
        id: &SessionId,
        role: EndpointRole,
        endpoint: &Endpoint,
    ) -> Option<String> {
        let user = self.sessions.get(id).and_then(|entry| entry.user);
        self.users.denial(user.filter(|_| role == EndpointRole::Application), endpoint)
    }

    /// Has the status and the log say that an endpoint is denied. Its session is not told: for a session REFUSED is for
    /// good, and other rules may allow the endpoint.
    pub(super) fn note_denied(&mut self, id: &SessionId, endpoint: &Endpoint, why: &str) {
        let refused = Refused::of(endpoint, why);
        self.sessions.note_refused(id, &refused.text);
    }
}
