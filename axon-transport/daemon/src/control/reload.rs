//! Reads the settings again that may change while the daemon runs: on SIGHUP, and when `axon reload` asks for it.
//!
//! If a setting is wrong, nothing changes.

use std::{cell::RefCell, ffi::OsString, rc::Rc, sync::Arc, time::Duration};

use axon_shm::ids::SessionId;
use axon_transport::{
    config::{Config, ConfigError, absolute_paths},
    status::ReloadReport,
};
use tokio::{signal::unix::Signal, time::timeout};

use super::{log, plane::ControlPlane};
use crate::bridge::TrafficRules;

/// Maximum time that the gateway may take to put new rules in force.
const IN_FORCE: Duration = Duration::from_secs(10);

/// The environment from which a daemon reads its settings.
#[derive(Clone, Debug)]
pub(super) struct SettingsSource {
    /// Settings that name files, as absolute paths.
    paths: Vec<(&'static str, Option<OsString>)>,
}

impl SettingsSource {
    /// Returns the environment of this process. Relative paths begin in its current directory.
    pub(super) fn environment() -> Self {
        Self { paths: absolute_paths() }
    }

    /// Reads the settings.
    ///
    /// # Errors
    /// A setting that is wrong.
    pub(super) fn read(&self) -> Result<Config, ConfigError> {
        Config::from_env_with(self.paths.iter().cloned(), None)?.with_rules_of_host()
    }
}

/// Reads the settings whenever SIGHUP comes or a session asks. A daemon that was given its configuration by a program
/// has no `source`.
pub(super) async fn reload(
    control: Rc<RefCell<ControlPlane>>,
    mut hangup: Signal,
    source: Option<SettingsSource>,
) {
    loop {
        let asked = Rc::clone(&control.borrow().reload);
        tokio::select! {
            _ = hangup.recv() => {}
            () = asked.notified() => {}
        }
        // Sessions that ask from here on are answered by the next reading.
        let asking = std::mem::take(&mut control.borrow_mut().reload_asked);
        // Reading files may hang with their file system.
        let mut report = match source.clone() {
            Some(source) => {
                let read = tokio::task::spawn_blocking(move || source.read()).await;
                let Ok(read) = read else { continue };
                control.borrow_mut().take_settings(read)
            }
            None => {
                let mut report = ReloadReport::default();
                let why = "a program gave this daemon its settings: they cannot be read again";
                report.error = Some(why.into());
                report
            }
        };
        log_report(&report);
        if let Err(error) = wait_in_force(&control).await {
            tracing::error!(error);
            report.error.get_or_insert(error);
        }
        let mut control = control.borrow_mut();
        for id in asking {
            control.answer_reload(&id, &report);
        }
        control.settle();
    }
}

/// Waits until the gateway has the rules in force: a session that asked may rely on them once it is answered.
///
/// # Errors
/// The gateway did not report that in time.
async fn wait_in_force(control: &Rc<RefCell<ControlPlane>>) -> Result<(), String> {
    let (number, mut in_force) = {
        let control = control.borrow();
        if control.gateway == "off" {
            return Ok(());
        }
        (control.rules.borrow().0, control.rules_in_force.subscribe())
    };
    let has_them = in_force.wait_for(|has| *has >= number);
    match timeout(IN_FORCE, has_them).await {
        Ok(_) => Ok(()),
        Err(_) => Err(format!(
            "the settings were read, but other hosts are not judged by the new rules yet: the gateway did not \
             take them within {} s. `axon status` says how it does",
            IN_FORCE.as_secs()
        )),
    }
}

fn log_report(report: &ReloadReport) {
    match &report.error {
        Some(error) => {
            tracing::error!(error, "could not read the settings again; the old ones stay in force")
        }
        None => tracing::info!(
            changed = report.changed.join(", "),
            needs_restart = report.needs_restart.join(", "),
            "the settings were read again"
        ),
    }
}

impl ControlPlane {
    /// Handles a session's request to read the settings again. Other users may not request that.
    pub(super) fn ask_reload(&mut self, id: &SessionId) {
        let user = self.registry.session(id).and_then(|entry| entry.user);
        if let Some(user) = user {
            let mut report = ReloadReport::default();
            report.error = Some(format!("user {user} may not change the settings of this daemon"));
            return self.answer_reload(id, &report);
        }
        self.reload_asked.push(*id);
        self.reload.notify_one();
    }

    fn answer_reload(&mut self, id: &SessionId, report: &ReloadReport) {
        let text = serde_json::to_vec(report).unwrap_or_default();
        self.registry.tell_status(id, text.into());
    }

    /// Takes over the settings that may change from settings that were read.
    fn take_settings(&mut self, read: Result<Config, ConfigError>) -> ReloadReport {
        let mut report = ReloadReport::default();
        let new = match read {
            Ok(new) => new,
            Err(error) => {
                report.error = Some(error.to_string());
                return report;
            }
        };
        let old = Arc::clone(&self.config);
        report.needs_restart = differing(&fixed(&old), &fixed(&new));
        if let Some(error) = unfit(&old, &new) {
            report.error = Some(error.to_owned());
            return report;
        }
        report.changed = differing(&variable(&old), &variable(&new));
        if !report.changed.is_empty() {
            let mut config = Config::clone(&old);
            config.access = new.access;
            config.access_file = new.access_file;
            config.daemon_peers = new.daemon_peers;
            config.trusted_uids = new.trusted_uids;
            config.log = new.log;
            config.topics = new.topics;
            self.set_config(config);
        }
        report
    }

    pub(super) fn set_config(&mut self, config: Config) {
        log::set_filter(&config.log);
        self.config = Arc::new(config);
        self.admission.set_config(&self.config);
        self.end_excluded();
        self.registry.set_access(self.config.access.clone());
        self.rules.send_modify(|(number, rules)| {
            *number += 1;
            *rules = TrafficRules::of(&self.config);
        });
        self.look_for_hosts();
    }
}

impl ControlPlane {
    /// Ends the sessions of users that are not trusted any more, and the sessions that share memory and would not be
    /// admitted with that now.
    fn end_excluded(&mut self) {
        let has_rules = !self.config.access.is_empty();
        let excluded = self.registry.sessions().filter_map(|(id, entry)| {
            let user = entry.user?;
            let shares = entry.relay.is_none() && entry.descriptors.is_some();
            (!self.admission.trusts(user) || has_rules && shares).then_some((*id, user))
        });
        for (id, user) in excluded.collect::<Vec<_>>() {
            tracing::warn!(session = %id, user, "a session of another user was ended: the settings changed");
            self.disconnect(&id);
        }
    }
}

/// Returns the reason why settings that were read are not taken over, though each of them is valid.
fn unfit(old: &Config, new: &Config) -> Option<&'static str> {
    // Rules are checked against the mode that they are read with.
    if format!("{:?}", old.security) != format!("{:?}", new.security) {
        return Some(
            "the settings of security differ from those in force (mode, files of keys and certificates, KME, \
             AXON_QKD_PEERS): start the daemon again to change them",
        );
    }
    // A file that is being written, or replaced, is empty or absent for a moment.
    if !old.access.is_empty() && new.access.is_empty() {
        return Some(
            "there are no access rules any more; to allow all, write default = \"allow\", or start the daemon again",
        );
    }
    (old.access.limits_anything() && !new.access.limits_anything()).then_some(
        "there is no [[limit]] any more; to change the limits leave one, or start the daemon again to have none",
    )
}

/// Settings by name, as text that differs if the settings differ.
type NamedSettings = Vec<(&'static str, String)>;

fn variable(config: &Config) -> NamedSettings {
    vec![
        ("access rules", format!("{:?} {:?}", config.access_file, config.access)),
        ("AXON_DAEMON_PEERS", format!("{:?}", config.daemon_peers)),
        ("AXON_TRUSTED_UIDS", format!("{:?}", config.trusted_uids)),
        ("AXON_LOG", config.log.clone()),
        ("[[topic]]", format!("{:?}", config.topics)),
    ]
}

fn fixed(config: &Config) -> NamedSettings {
    vec![
        ("security", format!("{:?}", config.security)),
        ("AXON_QUIC_CIPHER", config.cipher.name().to_owned()),
        ("ROS_DOMAIN_ID", config.domain.to_string()),
        ("AXON_BIND_ADDRS", format!("{:?}", config.bind_addrs)),
        ("AXON_ADVERTISE_ADDRS", format!("{:?}", config.advertise_addrs)),
        ("AXON_MAX_MESSAGE_MB", config.max_message.to_string()),
        ("AXON_RELIABLE_QUEUE_MB", config.reliable_queue.to_string()),
        ("[link]", format!("{:?}", config.link)),
    ]
}

fn differing(old: &NamedSettings, new: &NamedSettings) -> Vec<String> {
    let pairs = old.iter().zip(new).filter(|(old, new)| old.1 != new.1);
    pairs.map(|((name, _), _)| (*name).to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bridge::ToControl;
    use crate::control::descriptors::SpareDescriptors;
    use axon_transport::{
        access::{Principal, Verb},
        config::{TopicPattern, TopicPriority, TopicRule},
    };

    fn control(config: Config) -> ControlPlane {
        let settings = vec![("AXON_QUIC_CIPHER".into(), "x".into())];
        ControlPlane::new(Arc::new(config), settings, SpareDescriptors::default())
    }

    #[test]
    fn a_reload_applies_changeable_settings_and_lists_settings_that_need_a_restart() {
        let mut control = control(Config::default());
        let mut seen = control.rules.subscribe();
        let mut new = Config::builder().daemon_peers(["10.0.0.7"]).domain(3).build().unwrap();
        new.link.mtu = 9000;
        let topic = TopicPattern::new("/camera").unwrap();
        new.topics = vec![TopicRule::new(topic, TopicPriority::Low).max_hz(5.0)];
        let rules = "[[allow]]\npeer = \"uid:7\"\npublish = \"/x\"";
        new.access = axon_transport::access::AccessRules::parse(rules, "f").unwrap();
        let report = control.take_settings(Ok(new.clone()));
        assert_eq!(report.changed, ["access rules", "AXON_DAEMON_PEERS", "[[topic]]"]);
        assert_eq!(report.needs_restart, ["ROS_DOMAIN_ID", "[link]"]);
        assert_eq!((control.config.domain, control.config.link.mtu), (0, 1452));
        let denied = |rules: &axon_transport::access::AccessRules| {
            !rules.check(Principal::User(7), Verb::Publish, "/y").allowed()
        };
        assert!(seen.has_changed().unwrap() && denied(&seen.borrow_and_update().1.access));
        assert!(control.wanted.borrow().hosts.iter().any(|(host, _)| host == "10.0.0.7"));
        assert_eq!(seen.borrow().1.topics, new.topics);
        // Missing rules do not allow everything.
        let mut without = new.clone();
        without.access = Default::default();
        let report = control.take_settings(Ok(without));
        assert!(report.error.unwrap().contains("no access rules any more"));
        assert!(denied(&control.config.access) && !seen.has_changed().unwrap());
        let key = tempfile::NamedTempFile::new().unwrap();
        let pinned = Config::builder().classic_key(key.path()).classic_trust(key.path());
        let report = control.take_settings(Ok(pinned.build().unwrap()));
        assert!(report.error.unwrap().contains("security differ from those in force"));
        // The same rule holds for limits.
        let mut limited = new.clone();
        let limits = format!("{rules}\n[[limit]]\npeer = \"*\"\nrate = 1");
        limited.access = axon_transport::access::AccessRules::parse(&limits, "f").unwrap();
        assert_eq!(control.take_settings(Ok(limited.clone())).changed, ["access rules"]);
        assert!(seen.borrow_and_update().1.access.limits_anything());
        let report = control.take_settings(Ok(new));
        assert!(report.error.unwrap().contains("no [[limit]] any more"));
        // Reading the same settings again is no change.
        assert_eq!(control.take_settings(Ok(limited)).changed, Vec::<String>::new());
        assert!(!seen.has_changed().unwrap());
    }

    /// Creates a daemon whose gateway has started and has not yet taken over the new rules.
    fn reloaded() -> Rc<RefCell<ControlPlane>> {
        let mut control = control(Config::default());
        control.gateway_says(ToControl::Started { port: 1 });
        let rules = "[[allow]]\npeer = \"a\"\npublish = \"/x\"";
        let mut new = Config::default();
        new.access = axon_transport::access::AccessRules::parse(rules, "f").unwrap();
        assert_eq!(control.take_settings(Ok(new)).changed, ["access rules"]);
        Rc::new(RefCell::new(control))
    }

    #[tokio::test(start_paused = true)]
    async fn a_reload_is_answered_once_the_gateway_has_the_rules() {
        let control = reloaded();
        let in_force = wait_in_force(&control);
        tokio::pin!(in_force);
        let early = timeout(IN_FORCE / 2, &mut in_force).await;
        assert!(early.is_err(), "{early:?}");
        control.borrow_mut().gateway_says(ToControl::Rules(1));
        assert_eq!(in_force.await, Ok(()));
        // Rules that did not change are in force.
        assert_eq!(wait_in_force(&control).await, Ok(()));
    }

    #[tokio::test(start_paused = true)]
    async fn a_reload_whose_rules_the_gateway_does_not_take_fails_and_says_so() {
        let control = reloaded();
        control.borrow_mut().gateway_says(ToControl::Rules(0));
        let error = wait_in_force(&control).await.unwrap_err();
        assert!(error.contains("did not take them within 10 s"), "{error}");
        // A daemon without a gateway has no other hosts.
        control.borrow_mut().gateway = "off".into();
        assert_eq!(wait_in_force(&control).await, Ok(()));
    }

    #[test]
    fn wrong_settings_change_nothing_and_say_why() {
        let mut control = control(Config::builder().daemon_peers(["a"]).build().unwrap());
        let error = Config::builder().domain(999).build().unwrap_err();
        let report = control.take_settings(Err(error));
        assert!(report.error.unwrap().contains("ROS_DOMAIN_ID"));
        assert_eq!(control.config.daemon_peers.len(), 1);
    }
}
