//! Decides whether a process is accepted as a session: checks its user, and compares its HELLO with the daemon's
//! settings. Runs on the control plane's thread.

use std::sync::Arc;

use axon_shm::internal::{PeerDescriptors, PeerProcess, descriptors::PassedFd, out_of_reach};
use axon_transport::{
    config::{Config, security_settings},
    internal::{
        session::daemon::connect::SHM,
        wire::session::{PROTOCOL, SessionHello, SessionRefused, SessionRole},
    },
};

/// The setting that names the file of access rules.
const ACCESS_FILE: &str = "AXON_ACCESS_FILE";

/// The daemon's settings, with which it compares sessions.
#[derive(Debug)]
pub(super) struct Admission {
    uid: u32,
    config: Arc<Config>,
    settings: Vec<(String, String)>,
}

impl Admission {
    pub(super) fn new(config: Arc<Config>, settings: Vec<(String, String)>) -> Self {
        let uid = rustix::process::geteuid().as_raw();
        Self { uid, config, settings }
    }

    /// Takes over the settings that may change while the daemon runs.
    pub(super) fn set_config(&mut self, config: &Arc<Config>) {
        self.config = Arc::clone(config);
        self.settings.retain(|(name, _)| name != ACCESS_FILE);
        let file = config.access_file.as_ref().map(|file| file.to_string_lossy().into_owned());
        self.settings.extend(file.map(|file| (ACCESS_FILE.to_owned(), file)));
    }

    /// Returns the settings with which the last session was compared.
    pub(super) fn settings(&self) -> &[(String, String)] {
        &self.settings
    }

    /// Returns whether a process of this user may send messages at all.
    pub(super) fn trusts(&self, uid: u32) -> bool {
        uid == self.uid || self.config.trusted_uids.contains(&uid)
    }

    /// Like [`trusts`](Self::trusts), for a session that is about to be admitted.
    pub(super) fn still_trusts(&self, uid: u32) -> Result<(), Box<SessionRefused>> {
        let text = || format!("user {uid} is not trusted (AXON_TRUSTED_UIDS of the daemon)");
        if self.trusts(uid) { Ok(()) } else { Err(plain(text())) }
    }

    /// Returns whether this user is another one than the daemon's.
    pub(super) fn is_another(&self, uid: u32) -> bool {
        uid != self.uid
    }

    /// Checks a HELLO, and returns its descriptors. `inside` marks the daemon's own gateway.
    pub(super) fn check(
        &mut self,
        hello: &SessionHello,
        descriptors: Vec<PassedFd>,
        peer: PeerProcess,
        inside: bool,
    ) -> Result<Option<[PassedFd; 3]>, Box<SessionRefused>> {
        if hello.protocol != PROTOCOL {
            let text =
                format!("this daemon speaks session protocol {PROTOCOL}, not {}", hello.protocol);
            return Err(plain(text));
        }
        if hello.domain != self.config.domain {
            return Err(differs("ROS_DOMAIN_ID", &hello.domain, &self.config.domain));
        }
        if (hello.role == SessionRole::Gateway) != inside {
            return Err(plain("only the daemon's own gateway has that role".into()));
        }
        if hello.relay.is_some() && hello.role != SessionRole::Application {
            return Err(plain("only an application's session is relayed".into()));
        }
        // A tool only asks, for example why sessions are refused.
        if hello.role == SessionRole::Tool {
            return Ok(None);
        }
        if self.compare(&hello.settings).is_err() {
            self.read_files_again();
            self.compare(&hello.settings)?;
        }
        // A pair shares memory that also contains the samples of other topics.
        if hello.relay.is_none() && self.is_another(peer.uid) && !self.config.access.is_empty() {
            let text = "access rules are in force, and its user is another than the daemon's";
            return Err(unshared(text.into()));
        }
        let count = descriptors.len();
        if hello.relay.is_some() {
            return match count {
                0 => Ok(None),
                _ => Err(plain("a relayed session came with descriptors".into())),
            };
        }
        let Ok([segment, doorbell, pidfd]) = <[PassedFd; 3]>::try_from(descriptors) else {
            return Err(unshared(format!("HELLO came with {count} descriptors instead of three")));
        };
        if peer.pid == 0 {
            return Err(unshared(
                "its process is in a PID namespace that this daemon does not see: run both in one \
                 (containers: --pid=host)"
                    .into(),
            ));
        }
        // The daemon reads the segment, and reading any other file may block.
        if !segment.is_memfd() {
            return Err(plain("the segment in HELLO is no memfd".into()));
        }
        if let Some(error) = out_of_reach(&segment) {
            return Err(unshared(format!("the session's memory cannot be mapped: {error}")));
        }
        let handed = PeerDescriptors { segment, doorbell, pidfd };
        let own = handed
            .is_of(peer.pid)
            .map_err(|error| plain(format!("the pidfd in HELLO cannot be looked up: {error}")))?;
        if !own {
            return Err(plain("the pidfd in HELLO is not the sender's own".into()));
        }
        let PeerDescriptors { segment, doorbell, pidfd } = handed;
        Ok(Some([segment, doorbell, pidfd]))
    }

    /// Reads the hashes of the classic identity's files again: the files may change while the daemon runs. Its gateway
    /// reads them again, and a session has read their present content.
    fn read_files_again(&mut self) {
        let Ok(now) = security_settings(&self.config) else { return };
        let files = |name: &str, value: &str| {
            name.starts_with("AXON_CLASSIC_") && value.starts_with("sha256:")
        };
        for (name, value) in &mut self.settings {
            let same = |(n, v): &&(String, String)| n == name && files(n, v) && files(n, value);
            if let Some((_, read)) = now.iter().find(same) {
                value.clone_from(read);
            }
        }
    }

    fn compare(&self, theirs: &[(String, String)]) -> Result<(), Box<SessionRefused>> {
        let find = |all: &[(String, String)], name: &str| {
            all.iter().find(|(n, _)| n == name).map_or("unset".to_owned(), |(_, v)| v.clone())
        };
        let names = self.settings.iter().chain(theirs).map(|(name, _)| name);
        for name in names {
            // A session without rules is not less protected if the daemon has some.
            if name == ACCESS_FILE && find(theirs, name) == "unset" {
                continue;
            }
            let (session, daemon) = (find(theirs, name), find(&self.settings, name));
            if session != daemon {
                return Err(differs(name, &session, &daemon));
            }
        }
        Ok(())
    }
}

fn differs(
    variable: &str,
    session: &dyn std::fmt::Display,
    daemon: &dyn std::fmt::Display,
) -> Box<SessionRefused> {
    let (variable, ours, theirs) = (variable.to_owned(), session.to_string(), daemon.to_string());
    let text = format!("{variable} is {ours} in the session and {theirs} in the daemon");
    Box::new(SessionRefused { variable, ours, theirs, text, endpoint: None })
}

/// Returns the refusal of a session that cannot share memory: it may connect again to be relayed.
pub(super) fn unshared(text: String) -> Box<SessionRefused> {
    let [ours, theirs] = ["on", "off"].map(str::to_owned);
    Box::new(SessionRefused { variable: SHM.into(), ours, theirs, text, endpoint: None })
}

fn plain(text: String) -> Box<SessionRefused> {
    Box::new(SessionRefused::because(text))
}

#[cfg(test)]
mod tests {
    use std::os::fd::OwnedFd;

    use super::*;
    use axon_shm::ids::SessionId;
    use axon_transport::access::AccessRules;

    fn admission() -> Admission {
        let settings = [("AXON_SECURITY_MODE", "qkd"), ("AXON_SAE_ID", "alice")]
            .map(|(n, v)| (n.to_owned(), v.to_owned()));
        let env = [("ROS_DOMAIN_ID", "3"), ("AXON_TRUSTED_UIDS", "1001")];
        let env = env.map(|(n, v)| (n.into(), v.into()));
        let config = Config::resolve(env, None, &axon_transport::config::OsFiles).unwrap();
        Admission { uid: 1000, config: Arc::new(config), settings: settings.into() }
    }

    fn hello() -> SessionHello {
        SessionHello {
            protocol: PROTOCOL,
            session: SessionId::random(),
            role: SessionRole::Application,
            name: "test".into(),
            domain: 3,
            settings: admission().settings,
            relay: None,
            range: Some(0),
            static_peers: None,
        }
    }

    fn refusal(hello: &SessionHello) -> SessionRefused {
        let peer = PeerProcess { uid: 1000, pid: std::process::id() };
        *admission().check(hello, Vec::new(), peer, false).unwrap_err()
    }

    #[test]
    fn each_difference_is_named() {
        let mut other = hello();
        other.settings[1].1 = "bob".into();
        let refused = refusal(&other);
        assert_eq!(refused.variable, "AXON_SAE_ID");
        assert_eq!((refused.ours.as_str(), refused.theirs.as_str()), ("bob", "alice"));

        let mut missing = hello();
        missing.settings.pop();
        assert_eq!(refusal(&missing).variable, "AXON_SAE_ID");

        let mut extra = hello();
        extra.settings.push(("AXON_KME_ID".into(), "k".into()));
        assert_eq!(refusal(&extra).variable, "AXON_KME_ID");
        assert_eq!(refusal(&extra).theirs, "unset");

        let rules = ("AXON_ACCESS_FILE".to_owned(), "/a".to_owned());
        let mut with_rules = hello();
        with_rules.settings.push(rules.clone());
        assert_eq!(refusal(&with_rules).variable, rules.0, "the daemon has none");
        let mut daemon = admission();
        daemon.settings.push(rules);
        let peer = PeerProcess { uid: 1000, pid: std::process::id() };
        let refused = daemon.check(&hello(), Vec::new(), peer, false).unwrap_err();
        assert!(refused.text.contains("0 descriptors"), "a session without rules is let in");

        assert_eq!(refusal(&SessionHello { domain: 4, ..hello() }).variable, "ROS_DOMAIN_ID");
    }

    #[test]
    fn a_file_of_the_identity_may_change_and_nothing_else_may() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        let [key, trust] = ["key", "trust"].map(|name| dir.path().join(name));
        std::fs::write(&key, "").unwrap();
        std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o600)).unwrap();
        std::fs::write(&trust, "before").unwrap();
        let env = [("AXON_CLASSIC_KEY", &key), ("AXON_CLASSIC_TRUST", &trust)];
        let env = env.map(|(n, v)| (n.into(), v.into()));
        let config = Config::resolve(env, None, &axon_transport::config::OsFiles).unwrap();
        let mut admission =
            Admission::new(Arc::new(config.clone()), security_settings(&config).unwrap());
        let mut why = |settings| {
            let peer = PeerProcess { uid: 1000, pid: std::process::id() };
            let hello = SessionHello { domain: 0, settings, ..hello() };
            admission.check(&hello, Vec::new(), peer, false).unwrap_err().text
        };
        let of_its_own = "0 descriptors";
        let before = security_settings(&config).unwrap();
        assert!(why(before.clone()).contains(of_its_own));
        std::fs::write(&trust, "after").unwrap();
        let after = security_settings(&config).unwrap();
        assert!(why(after.clone()).contains(of_its_own), "as the file is now");
        assert!(why(before).contains("AXON_CLASSIC_TRUST"), "as nobody has it any more");
        let mut other = after;
        let cipher = other.iter_mut().find(|(name, _)| name == "AXON_QUIC_CIPHER").unwrap();
        cipher.1 = "aes-256-gcm".into();
        assert!(why(other).contains("AXON_QUIC_CIPHER"));
    }

    #[test]
    fn another_user_shares_no_memory_where_there_are_rules() {
        let check = |rules: &str, uid| {
            let mut admission = admission();
            let mut config = Config::clone(&admission.config);
            config.access = AccessRules::parse(rules, "f").unwrap();
            admission.config = Arc::new(config);
            let peer = PeerProcess { uid, pid: std::process::id() };
            admission.check(&hello(), Vec::new(), peer, false).unwrap_err().text
        };
        let rules = "default = \"allow\"";
        assert!(check(rules, 1001).contains("access rules are in force"));
        assert!(check(rules, 1000).contains("0 descriptors"), "the own user shares memory");
        let relayed = SessionHello { relay: Some("why".into()), ..hello() };
        let peer = PeerProcess { uid: 1001, pid: std::process::id() };
        assert!(admission().check(&relayed, Vec::new(), peer, false).unwrap().is_none());
    }

    #[test]
    fn gateway_hellos_are_refused_and_unlisted_users_are_not_trusted() {
        let gateway = SessionHello { role: SessionRole::Gateway, ..hello() };
        assert!(refusal(&gateway).text.contains("gateway"));
        assert!(
            refusal(&SessionHello { protocol: PROTOCOL + 1, ..hello() }).text.contains("protocol")
        );
        assert!(refusal(&hello()).text.contains("0 descriptors"));
        assert!(admission().trusts(1000) && admission().trusts(1001) && !admission().trusts(0));
    }

    #[test]
    fn a_pidfd_of_another_process_is_refused() {
        use rustix::process::{Pid, PidfdFlags, pidfd_open};
        let null = || PassedFd::from(OwnedFd::from(std::fs::File::open("/dev/null").unwrap()));
        let parent = rustix::process::getppid().unwrap();
        let of = |pid: Pid| PassedFd::from(pidfd_open(pid, PidfdFlags::empty()).unwrap());
        let peer = PeerProcess { uid: 1000, pid: std::process::id() };
        let memfd = || {
            let flags = rustix::fs::MemfdFlags::CLOEXEC;
            PassedFd::from(rustix::fs::memfd_create("test", flags).unwrap())
        };
        let check = |pidfd| admission().check(&hello(), vec![memfd(), null(), pidfd], peer, false);
        assert!(check(of(parent)).unwrap_err().text.contains("pidfd"));
        assert!(check(null()).unwrap_err().text.contains("pidfd"));
        let own = || of(rustix::process::getpid());
        assert!(check(own()).unwrap().is_some());
        let fds = vec![null(), null(), own()];
        let refused = admission().check(&hello(), fds, peer, false).unwrap_err();
        assert!(refused.text.contains("memfd"));
        // SO_PEERCRED shows a process in a PID namespace of its own so.
        let hidden = PeerProcess { pid: 0, ..peer };
        let fds = vec![memfd(), null(), own()];
        let refused = admission().check(&hello(), fds, hidden, false).unwrap_err();
        assert!(refused.text.contains("PID namespace"));
    }
}
