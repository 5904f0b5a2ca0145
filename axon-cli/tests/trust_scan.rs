//! `axon trust scan` of a real daemon with a key that `axon trust keygen` made.

#![forbid(unsafe_code)]

mod common;

use std::{
    fs,
    net::UdpSocket,
    process::{Child, Command, Output, Stdio},
};

use axon_tls::{
    Cipher,
    identity::{Auth, SigningKey},
    quic::hybrid_server,
};
use common::{Host, axon, eventually};

/// A daemon in the foreground; it ends with its standard input.
struct Daemon(Child);

impl Daemon {
    fn start(mut command: Command) -> Self {
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().expect("the daemon starts"))
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

#[track_caller]
fn printed(output: &Output) -> String {
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn scan_prints_the_line_that_keygen_printed() {
    let dir = tempfile::tempdir().expect("directory");
    let path = |name: &str| dir.path().join(name).to_str().expect("UTF-8").to_owned();
    for algorithm in ["ml-dsa-65", "ed25519"] {
        let (key, trust) = (path(&format!("{algorithm}.key")), path(&format!("{algorithm}.trust")));
        let keygen = ["trust", "keygen", &key, "--name", "127.0.0.1", "--algorithm", algorithm];
        let line = printed(&axon([]).args(keygen).output().expect("runs"));
        // The daemon trusts somebody, and not the tool: a scan needs nobody's trust.
        let peer = axon([]).args(["trust", "keygen", &path(&format!("{algorithm}.peer"))]).output();
        fs::write(&trust, printed(&peer.expect("runs"))).expect("writable");

        let host = Host::new();
        let pinned = |args: &[&str]| {
            let mut command = host.axon(args);
            command.envs([("AXON_CLASSIC_KEY", &key), ("AXON_CLASSIC_TRUST", &trust)]);
            command
        };
        let status = || -> Option<serde_json::Value> {
            let output = pinned(&["status", "--json"]).output().expect("runs");
            output.status.success().then(|| serde_json::from_slice(&output.stdout).expect("JSON"))
        };
        let _daemon = Daemon::start(pinned(&["daemon", "--while-stdin"]));
        let port = || status()?["port"].as_u64();
        eventually("a daemon with a port", || port().is_some());
        let at = format!("127.0.0.1:{}", port().expect("a port"));

        // With the port, and by trying those of the domain. Other tests' daemons may be among the
        // latter, on other addresses.
        for target in [at.as_str(), "127.0.0.1"] {
            let output = host.run(&["trust", "scan", target]);
            let lines = printed(&output);
            assert!(lines.contains(line.as_str()), "{target}: {lines:?} instead of {line:?}");
            let notes = text(&output.stderr);
            assert!(notes.contains("Nothing was verified"), "{notes}");
            assert!(notes.contains(&format!("# {at} signed")), "{notes}");
        }
        let output = host.run(&["trust", "scan", &at, "--name", "arm-2"]);
        assert_eq!(printed(&output), line.replacen("127.0.0.1 ", "arm-2 ", 1));

        // The daemon linked with no peer, and reports the attempt.
        eventually("a refusal in the daemon's status", || {
            status().is_some_and(|s| s["refusals"].as_array().is_some_and(|r| !r.is_empty()))
        });
        assert_eq!(status().expect("status")["links"].as_array().map(Vec::len), Some(0));
    }
}

#[test]
fn trust_scan_of_a_silent_target_prints_no_key() {
    let deaf = UdpSocket::bind(("127.0.0.1", 0)).expect("a socket");
    let target = deaf.local_addr().expect("an address").to_string();
    let scan = ["trust", "scan", target.as_str(), "--timeout", "1"];
    let output = axon([]).args(scan).output().expect("runs");
    assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(1), &b""[..]));
    let stderr = text(&output.stderr);
    assert!(stderr.contains("no key was shown") && stderr.contains("127.0.0.1"), "{stderr}");
}

/// Starts a server that speaks QUIC and is not a daemon.
fn serve(runtime: &tokio::runtime::Runtime, config: quinn::ServerConfig) -> String {
    let _entered = runtime.enter();
    let server = quinn::Endpoint::server(config, ([127, 0, 0, 1], 0).into()).expect("endpoint");
    let address = server.local_addr().expect("an address").to_string();
    runtime.spawn(async move {
        while let Some(incoming) = server.accept().await {
            assert!(incoming.await.is_err(), "a connection");
        }
    });
    address
}

#[test]
fn a_server_that_is_no_daemon_is_told_from_silence() {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("tokio");
    let auth = Auth::None(SigningKey::generate().expect("a key"));
    let web = hybrid_server(&auth, Cipher::default(), b"h3").expect("a server");
    // Most servers have this: a certificate, and only X25519.
    let key = rcgen::KeyPair::generate().expect("a key");
    let params = rcgen::CertificateParams::new(["robot".to_owned()]).expect("a name");
    let certificate = params.self_signed(&key).expect("a certificate").der().clone();
    let key = rustls::pki_types::PrivatePkcs8KeyDer::from(key.serialize_der());
    let provider = rustls::crypto::CryptoProvider {
        kx_groups: vec![rustls::crypto::aws_lc_rs::kx_group::X25519],
        ..rustls::crypto::aws_lc_rs::default_provider()
    };
    let mut tls = rustls::ServerConfig::builder_with_provider(provider.into())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("TLS 1.3")
        .with_no_client_auth()
        .with_single_cert(vec![certificate], key.into())
        .expect("a certificate and its key");
    tls.alpn_protocols = vec![b"axon/1".to_vec()];
    let tls = quinn::crypto::rustls::QuicServerConfig::try_from(tls).expect("QUIC");
    let classical = quinn::ServerConfig::with_crypto(std::sync::Arc::new(tls));
    for (config, said) in [(web, "not axon/1"), (classical, "refuses X25519MLKEM768")] {
        let target = serve(&runtime, config);
        let scan = ["trust", "scan", target.as_str(), "--timeout", "20"];
        let output = axon([]).args(scan).output().expect("runs");
        let stderr = text(&output.stderr);
        assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(1), &b""[..]));
        let line = stderr.lines().find(|line| line.starts_with(&format!("# {target} ")));
        assert!(line.is_some_and(|line| line.contains(said)), "{said}: {stderr}");
        assert!(stderr.contains("who answered instead"), "{stderr}");
        assert!(!stderr.contains("let through"), "the network is not to blame: {stderr}");
    }

    // TLS over TCP is another port to QUIC, whatever its number.
    let tcp = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("a socket");
    let target = tcp.local_addr().expect("an address").to_string();
    let scan = ["trust", "scan", target.as_str(), "--timeout", "1"];
    let output = axon([]).args(scan).output().expect("runs");
    assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(1), &b""[..]));
    assert!(text(&output.stderr).contains("UDP port"), "{}", text(&output.stderr));
}

#[test]
fn a_target_that_means_nothing_is_refused() {
    for (target, status) in
        [("", 2), ("a:0", 2), ("[::1", 2), ("127.0.0.1:61300x", 2), ("no-such-host.invalid", 1)]
    {
        let scan = ["trust", "scan", target, "--timeout", "1"];
        let output = axon([]).args(scan).output().expect("runs");
        assert_eq!(output.status.code(), Some(status), "{target}: {}", text(&output.stderr));
        assert_eq!(output.stdout, b"", "{target}");
    }
    let scan = ["trust", "scan", "127.0.0.1", "--name", "two words"];
    let output = axon([]).args(scan).output().expect("runs");
    assert_eq!(output.status.code(), Some(2));
    let output = axon([("ROS_DOMAIN_ID", "many")]).args(&scan[..3]).output().expect("runs");
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("ROS_DOMAIN_ID"));
}
