//! Other users of the host, whose sessions share no memory where there are rules. Only root can play them.

use std::{
    os::unix::fs::PermissionsExt,
    path::Path,
    sync::atomic::{AtomicU32, Ordering},
};

use axon_tests::{Sizes, payload};

use super::{super::process::Node, *};

/// The other user.
const NOBODY: u32 = 65534;

/// A copy of the program that plays a node, where another user can run it.
struct NodeOfOthers(PathBuf);

impl NodeOfOthers {
    fn new() -> Self {
        static COPIES: AtomicU32 = AtomicU32::new(0);
        let copy = COPIES.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("axon-node-{}-{copy}", std::process::id()));
        fs::copy(env!("CARGO_BIN_EXE_axon-test-node"), &path).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        Self(path)
    }
}

impl Drop for NodeOfOthers {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

/// Starts a host whose daemon admits another user, under these rules; `None` if the test can play only one user.
fn host_of_two(rules: &str) -> Option<(Host, Session)> {
    if !rustix::process::geteuid().is_root() {
        eprintln!("skipped: only root can be two users");
        return None;
    }
    let [mut host, _] = Plan::new([classic(&[]), classic(&[])]).prepare();
    host.set("AXON_ACCESS_FILE", path_of(&host).to_str().unwrap());
    host.set("AXON_TRUSTED_UIDS", &format!("0;{NOBODY}"));
    fs::write(path_of(&host), rules).unwrap();
    host.start();
    let open = |path: &Path| fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
    open(host.dir.path());
    open(&host.dir.path().join("run"));
    let session = host.session("own");
    Some((host, session))
}

/// Returns the path of a host's rules.
fn path_of(host: &Host) -> PathBuf {
    host.dir.path().join("access.toml")
}

fn change(host: &Host, rules: &str) {
    fs::write(path_of(host), rules).unwrap();
    let report = daemon_reload_at(&DaemonLocation::from(&host.config())).unwrap();
    assert_eq!((report.changed, report.error), (vec!["access rules".to_owned()], None));
}

#[test]
fn another_user_of_the_host_publishes_only_on_allowed_topics() {
    let rules = format!("[[allow]]\npeer = \"uid:{NOBODY}\"\npublish = \"/allowed\"");
    let Some((robot, session)) = host_of_two(&rules) else { return };
    let spec = |topic| EndpointSpec::new(topic, "test/Bytes", Qos::keep_all());
    let [allowed, denied] =
        ["/allowed", "/denied"].map(|topic| session.create_subscription(spec(topic)).unwrap());
    let program = NodeOfOthers::new();
    let denied_node =
        robot.node_of(&program.0, NOBODY, &["publish", "/denied", "small", "0", "stream"]);
    let allowed_node =
        robot.node_of(&program.0, NOBODY, &["publish", "/allowed", "small", "1", "10"]);
    let mut bytes = Vec::new();
    for _ in 0..10 {
        allowed.recv(&mut bytes, Some(PATIENCE)).expect("a sample of the other user");
    }
    robot.wait_refusal("the daemon says which rule denies", |refusal| {
        refusal.contains("\"/denied\": denied: no [[allow]] in access.toml permits this")
    });
    // The program itself logs it as well, because it does not see the daemon's log.
    let said =
        ["the daemon refuses an endpoint", "/denied", "no [[allow]] in access.toml permits this"];
    robot.wait_log(&said);
    assert!(!denied.has_data() && denied.matched().is_empty());
    assert!(
        session
            .graph()
            .endpoints
            .values()
            .all(|e| e.endpoint.topic != "/denied" || e.endpoint.gid == denied.gid())
    );
    // The rules change, and with them the pairs.
    change(&robot, "[[allow]]\npeer = \"local\"\npublish = \"/denied\"");
    denied.recv(&mut bytes, Some(PATIENCE)).expect("a sample that is allowed now");
    drop((denied_node, allowed_node));
}

/// A publisher of the node's kind of samples, and the number of the samples that were published.
struct Numbers(Publisher, u64);

impl Numbers {
    fn publish(&mut self, count: u64) {
        let mut bytes = Vec::new();
        for _ in 0..count {
            self.1 += 1;
            payload(Sizes::Small, self.1, &mut bytes);
            self.0.publish(&bytes).unwrap();
        }
    }
}

#[test]
fn another_user_reads_history_calls_and_serves_only_as_allowed() {
    let rules = format!(
        "[[allow]]\npeer = \"uid:{NOBODY}\"\nsubscribe = \"/read\"\ncall = \"/ask\"\nserve = \"/serve\""
    );
    let Some((host, session)) = host_of_two(&rules) else { return };
    let program = NodeOfOthers::new();
    let node = |arguments: &[&str]| host.node_of(&program.0, NOBODY, arguments);
    let [mut read, mut secret] =
        ["/read", "/secret"].map(|topic| Numbers(publisher(&session, topic), 0));
    // Before the other user comes: history is a way in, too.
    read.publish(5);
    secret.publish(5);
    let service = |name: &str| EndpointSpec::new(name.to_owned(), "test/Echo", Qos::default());
    let [asked, closed] =
        ["/ask", "/closed"].map(|name| session.create_server(service(name)).unwrap());
    let [client, blind] =
        ["/serve", "/hidden"].map(|name| session.create_client(service(name)).unwrap());

    let mut denied =
        [["history", "/secret", "small"], ["serve", "/hidden", "1"], ["ask", "/closed", "1"]]
            .map(|arguments| node(&arguments));
    denied[0].wait_ready();
    denied[1].wait_ready();
    let mut reads = node(&["history", "/read", "small"]);
    reads.wait_taken(5);
    read.publish(5);
    secret.publish(5);
    reads.wait_taken(10);
    let mut bytes = Vec::new();
    let _asks = node(&["ask", "/ask", "1"]);
    asked.recv_request(&mut bytes, Some(PATIENCE)).expect("a request of the other user");
    let _serves = node(&["serve", "/serve", "1"]);
    assert!(client.wait_available(PATIENCE));
    client.send_request(b"abc").unwrap();
    client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response of the other user");
    assert_eq!(bytes, b"cba");

    let shows = |what: &str| {
        let why = format!("\"{what}\": denied: no [[allow]] in access.toml permits this");
        host.wait_refusal("the daemon says which rule denies", |text| text.contains(&why));
    };
    ["/secret", "/hidden", "/closed"].iter().for_each(|name| shows(name));
    assert_eq!(denied[0].tally().taken, 0);
    assert!(secret.0.matched().is_empty() && !blind.is_available());
    assert!(closed.recv_request(&mut bytes, Some(Duration::ZERO)).is_err());
    assert_eq!((reads.tally().first, reads.tally().lost), (1, 0));
}

#[test]
fn samples_of_and_for_another_user_end_when_rules_deny_them_while_they_flow() {
    let rules = |topics: &str| {
        let peer = format!("[[allow]]\npeer = \"uid:{NOBODY}\"\n");
        format!("{peer}publish = [{topics}]\nsubscribe = [{topics}]\nsee = \"/**\"\n")
    };
    let Some((host, session)) = host_of_two(&rules("\"/in\", \"/out\", \"/still\"")) else {
        return;
    };
    let program = NodeOfOthers::new();
    let node = |arguments: &[&str]| host.node_of(&program.0, NOBODY, arguments);
    let own = |topic: &str| EndpointSpec::new(topic.to_owned(), "test/Bytes", Qos::keep_all());
    let comes = session.create_subscription(own("/in")).unwrap();
    let [mut out, mut still] =
        ["/out", "/still"].map(|topic| Numbers(session.create_publisher(own(topic)).unwrap(), 0));
    let mut writes = node(&["publish", "/in", "small", "1", "stream"]);
    let mut reads = ["/out", "/still"].map(|topic| node(&["subscribe", topic, "small"]));
    reads.iter_mut().for_each(Node::wait_ready);
    until("all flows", || {
        let matched = |numbers: &Numbers| !numbers.0.matched().is_empty();
        matched(&out) && matched(&still) && comes.has_data()
    });
    out.publish(10);
    still.publish(10);
    reads[0].wait_taken(10);
    reads[1].wait_taken(10);

    change(&host, &rules("\"/still\""));
    until("the pairs that are not allowed any more end", || {
        comes.matched().is_empty() && out.0.matched().is_empty()
    });
    let mut bytes = Vec::new();
    while comes.take(&mut bytes).is_some() {}
    let published = writes.published();
    for _ in 0..20 {
        out.publish(10);
        still.publish(10);
    }
    reads[1].wait_taken(210);
    until("the other user goes on", || writes.published() > published + 200);
    assert_eq!(reads[0].tally().last, 10, "what was published after the pair ended");
    assert!(!comes.has_data());
    // The peer gets the reason.
    host.wait_refusal("the daemon says what is denied", |text| {
        text.contains("\"/in\": denied: no [[allow]] in access.toml permits this")
    });
}
