//! Limits on the bytes a second that leave this host by one network interface, for all peers together.

use std::{collections::BTreeMap, net::IpAddr, rc::Rc};

use axon_transport::access::{AccessRules, InterfaceLimit};

use super::egress::EgressCap;
use crate::discovery::Interface;

/// The limits of interfaces, and which interface has which address.
#[derive(Debug, Default)]
pub(crate) struct InterfaceLimits {
    rules: Vec<InterfaceLimit>,
    known: Vec<Interface>,
    /// The limits by the name of the interface. A limit stays while a rule sets it, so that an interface that comes
    /// back does not start with a full bucket.
    caps: BTreeMap<String, Vec<Rc<EgressCap>>>,
    /// Whether the owner was asked for the list of interfaces, and has not answered.
    is_asked: bool,
    /// Whether the owner has to be asked again.
    is_wanted: bool,
}

impl InterfaceLimits {
    /// Replaces the rules. Limits that they still set stay as full as they are.
    pub(crate) fn set_rules(&mut self, rules: &AccessRules) {
        self.rules = rules.interface_limits().to_vec();
        self.is_wanted = !self.rules.is_empty();
        self.renew();
    }

    /// Handles the list of this host's interfaces, for which [`asks`](Self::asks) asked.
    pub(crate) fn set_interfaces(&mut self, known: Vec<Interface>) {
        self.is_asked = false;
        self.known = known;
        self.renew();
    }

    /// Handles a new local address of a connection: the interfaces may have changed.
    pub(crate) fn handle_address(&mut self) {
        self.is_wanted = !self.rules.is_empty();
    }

    /// Returns whether the owner has to be asked for the interfaces now. At most one question is open.
    pub(crate) fn asks(&mut self) -> bool {
        let asks = self.is_wanted && !self.is_asked;
        if asks {
            (self.is_wanted, self.is_asked) = (false, true);
        }
        asks
    }

    fn renew(&mut self) {
        let (mut before, rules) = (std::mem::take(&mut self.caps), &self.rules);
        let names = self.known.iter().map(|interface| &interface.name);
        let names: Vec<String> = names.chain(before.keys()).cloned().collect();
        for name in names {
            if self.caps.contains_key(&name) {
                continue;
            }
            let had = before.remove(&name).unwrap_or_default();
            let of_rule = |rule: &InterfaceLimit| {
                let had = had.iter().find(|cap| cap.is(&rule.limit)).cloned();
                had.unwrap_or_else(|| Rc::new(EgressCap::of_interface(&rule.limit, &name)))
            };
            let set = rules.iter().filter(|rule| rule.names(&name)).map(of_rule);
            let set: Vec<_> = set.collect();
            if !set.is_empty() {
                self.caps.insert(name, set);
            }
        }
    }

    /// Returns the limits on packets that leave from a local address.
    pub(super) fn of(&self, local: IpAddr) -> &[Rc<EgressCap>] {
        let interface = self.interface(local);
        interface.and_then(|interface| self.caps.get(&interface.name)).map_or(&[], Vec::as_slice)
    }

    /// Returns whether the limits on packets from a local address may be missing, because no known interface has the
    /// address.
    pub(crate) fn misses(&self, local: IpAddr) -> bool {
        // An empty list means that the first list has not arrived yet.
        let is_listed = !self.known.is_empty();
        is_listed && !self.rules.is_empty() && self.interface(local).is_none()
    }

    fn interface(&self, local: IpAddr) -> Option<&Interface> {
        let local = local.to_canonical();
        // All of 127.0.0.0/8 is the loopback interface's.
        let has = |i: &&Interface| i.address == local || (i.loopback && i.contains(local));
        self.known.iter().find(has)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::engine::limits::Egress;

    fn rules(text: &str) -> AccessRules {
        AccessRules::parse(text, "access.toml").unwrap()
    }

    fn interface(name: &str, address: &str) -> Interface {
        Interface {
            name: name.to_owned(),
            index: 1,
            address: address.parse().unwrap(),
            prefix: 8,
            broadcast: None,
            loopback: name == "lo",
        }
    }

    fn host() -> Vec<Interface> {
        vec![
            interface("lo", "127.0.0.1"),
            interface("wlan0", "10.0.0.1"),
            interface("wlan0", "2001:db8::1"),
            interface("wlan1", "10.0.1.1"),
            interface("eth0", "10.0.2.1"),
        ]
    }

    fn limits(text: &str) -> InterfaceLimits {
        let mut limits = InterfaceLimits::default();
        limits.set_rules(&rules(text));
        limits.set_interfaces(host());
        limits
    }

    fn texts(limits: &InterfaceLimits, local: &str) -> Vec<String> {
        let of = limits.of(local.parse().unwrap()).iter().map(|cap| cap.status());
        of.map(|status| format!("{} {}", status.name, status.limit)).collect()
    }

    #[test]
    fn each_interface_that_a_rule_names_has_a_limit_of_its_own() {
        let limits = limits(
            "[[limit]]\ninterface = \"wlan*\"\negress = \"1 MB/s\"\n\
             [[limit]]\ninterface = [\"wlan1\", \"lo\"]\negress = \"2 MB/s\"",
        );
        assert_eq!(texts(&limits, "10.0.0.1"), ["(all packets by wlan0) 1 MB/s"]);
        assert_eq!(texts(&limits, "::ffff:10.0.0.1"), texts(&limits, "10.0.0.1"));
        let wlan1 = ["(all packets by wlan1) 1 MB/s", "(all packets by wlan1) 2 MB/s"];
        assert_eq!(texts(&limits, "10.0.1.1"), wlan1);
        assert_eq!(texts(&limits, "127.7.0.9"), ["(all packets by lo) 2 MB/s"]);
        for (free, missed) in [("10.0.2.1", false), ("10.0.0.2", true), ("::1", true)] {
            assert!(texts(&limits, free).is_empty(), "{free}");
            assert_eq!(limits.misses(free.parse().unwrap()), missed, "{free}");
        }
        let of = |local: &str| limits.of(local.parse().unwrap())[0].clone();
        assert!(Rc::ptr_eq(&of("10.0.0.1"), &of("2001:db8::1")), "one interface, two addresses");
        assert!(!Rc::ptr_eq(&of("10.0.0.1"), &of("10.0.1.1")));
    }

    #[test]
    fn bucket_of_a_limit_keeps_its_level_over_a_reload() {
        let text = "[[limit]]\ninterface = \"wlan0\"\negress = \"10 kB/s\"";
        let mut limits = limits(text);
        let is_closed = |limits: &InterfaceLimits| {
            let mut egress = Egress::default();
            egress.set_interface(limits, "10.0.0.1".parse().unwrap());
            let is_closed = egress.closed_until(Duration::ZERO).is_some();
            egress.sent(10, 15_000, Duration::ZERO);
            is_closed
        };
        assert!(!is_closed(&limits));
        limits.set_rules(&rules(text));
        assert!(is_closed(&limits));
        // The interface is gone and comes back.
        limits.set_interfaces(Vec::new());
        assert!(texts(&limits, "10.0.0.1").is_empty());
        limits.set_interfaces(host());
        assert!(is_closed(&limits));
        limits.set_rules(&rules("default = \"allow\""));
        assert!(texts(&limits, "10.0.0.1").is_empty());
        limits.set_rules(&rules(text));
        assert!(!is_closed(&limits), "the limit was gone");
    }

    #[test]
    fn interfaces_are_asked_for_where_a_rule_needs_them_one_question_at_a_time() {
        let mut limits = InterfaceLimits::default();
        limits.handle_address();
        assert!(!limits.asks(), "no rule");
        limits.set_rules(&rules("[[limit]]\ninterface = \"wlan0\"\negress = \"10 kB/s\""));
        assert!(limits.asks() && !limits.asks());
        (0..9).for_each(|_| limits.handle_address());
        assert!(!limits.asks(), "the answer is under way");
        limits.set_interfaces(host());
        assert!(limits.asks() && !limits.asks());
        limits.set_interfaces(host());
        assert!(!limits.asks());
    }
}
