//! Access rules for other users of this host.
//!
//! The sessions of the daemon's own user are not restricted, because a process with that user's rights can do
//! anything to them.

use std::collections::HashMap;

use super::{Endpoint, permits, shows, verb_of};
use crate::access::{AccessRules, Permissions, Principal};

/// The access rules, compiled for each user who has or had a session.
#[derive(Debug, Default)]
pub(crate) struct Users {
    rules: AccessRules,
    permissions: HashMap<u32, Permissions>,
}

impl Users {
    pub(crate) fn have_rules(&self) -> bool {
        !self.rules.is_empty()
    }

    pub(crate) fn add(&mut self, user: u32) {
        let rules = &self.rules;
        self.permissions.entry(user).or_insert_with(|| rules.permissions(Principal::User(user)));
    }

    pub(crate) fn set_rules(&mut self, rules: AccessRules) {
        for (user, permissions) in &mut self.permissions {
            *permissions = rules.permissions(Principal::User(*user));
        }
        self.rules = rules;
    }

    /// Returns the reason why a user may not have an endpoint, or `None` if it may.
    pub(crate) fn denial(&self, user: Option<u32>, endpoint: &Endpoint) -> Option<String> {
        let permissions = self.permissions.get(&user?)?;
        if permits(permissions, endpoint) {
            return None;
        }
        Some(match verb_of(endpoint.kind) {
            Some(verb) => permissions.check(verb, &endpoint.topic).to_string(),
            None => {
                let file = self.rules.file().unwrap_or_default();
                format!("denied: nothing in {file} lets its user do anything")
            }
        })
    }

    /// Returns whether `user` may see an endpoint of a session of user `of`.
    pub(crate) fn shows(&self, user: Option<u32>, of: Option<u32>, endpoint: &Endpoint) -> bool {
        let permissions = user.and_then(|user| self.permissions.get(&user));
        user == of || permissions.is_none_or(|permissions| shows(permissions, endpoint))
    }
}
