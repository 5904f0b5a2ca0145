//! Tests the binary under thousands of connections that do not authenticate, and under clients that leave while it has
//! a fault.

#![cfg(target_os = "linux")]

mod program;

use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use etsi_qkd014::{Client, RetryPolicy};
use program::{Killed, kme_sim};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Connections that a KME serves at a time.
const PLACES: usize = 1024;
/// In each of the floods.
const CONNECTIONS: usize = 250;
const MINUTE: Duration = Duration::from_secs(60);

impl Killed {
    /// Starts `kme-sim run` with these arguments behind the directory's. Also returns the address of its one KME.
    fn start(dir: &Path, limits: &str, arguments: &[&str]) -> (Self, SocketAddr) {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let addr: SocketAddr = ([127, 0, 0, 1], port).into();
        let site = format!("kme-a={addr}=sae-a,sae-b");
        let mut init = kme_sim();
        assert!(
            init.arg("init").arg(dir).args(["--kme", &site]).output().unwrap().status.success()
        );
        // A shell, for the limits that a test may set.
        let mut run = Command::new("sh");
        run.args(["-c", &format!("{limits} exec \"$0\" run \"$@\"")]);
        run.arg(env!("CARGO_BIN_EXE_kme-sim")).arg(dir).args(arguments).stdout(Stdio::piped());
        let mut run = Self(run.spawn().unwrap());
        let mut lines = BufReader::new(run.0.stdout.take().unwrap()).lines();
        lines.next().unwrap().unwrap();
        (run, addr)
    }

    /// Returns the number of open files and sockets.
    fn files(&self) -> usize {
        std::fs::read_dir(format!("/proc/{}/fd", self.0.id())).unwrap().count()
    }

    /// Returns the resident memory in KiB.
    fn memory(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.0.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    }
}

/// Returns a client with its own connections that calls once.
fn client(dir: &Path, addr: SocketAddr) -> Client {
    Client::builder()
        .kme_url(format!("https://{addr}"))
        .ca_file(dir.join("ca.pem"))
        .sae_cert_file(dir.join("sae-a.crt"))
        .sae_key_file(dir.join("sae-a.key"))
        .retry(RetryPolicy::none())
        .timeout(MINUTE)
        .connect_timeout(MINUTE)
        .deadline(MINUTE)
        .build()
        .unwrap()
}

/// Opens a part of the connections, or as many as this process may open.
fn flood(addr: SocketAddr) -> Vec<TcpStream> {
    let mut open = Vec::new();
    for _ in 0..CONNECTIONS {
        match TcpStream::connect_timeout(&addr, MINUTE) {
            Ok(stream) => open.push(stream),
            Err(error) => {
                const EMFILE: i32 = 24;
                assert_eq!(error.raw_os_error(), Some(EMFILE), "{error}");
                // Others here need some too.
                open.truncate(open.len().saturating_sub(8));
                break;
            }
        }
    }
    open
}

/// Lets this process have as many files open as the system lets it.
fn raise_limit() {
    let limit = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit }).unwrap();
}

async fn strangers_shut_nobody_out(limits: &str, floods: usize) {
    raise_limit();
    let dir = tempfile::tempdir().unwrap();
    let (run, addr) = Killed::start(dir.path(), limits, &[]);
    let known = client(dir.path(), addr);
    known.enc_keys("sae-b").send().await.unwrap();
    let before = run.memory();

    let floods: Vec<_> = (0..floods).map(|_| std::thread::spawn(move || flood(addr))).collect();
    // A known client is served all the time.
    let mut asked = 0;
    while floods.iter().any(|flood| !flood.is_finished()) || asked == 0 {
        known.status("sae-b").await.unwrap();
        asked += 1;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let strangers: Vec<_> = floods.into_iter().flat_map(|flood| flood.join().unwrap()).collect();
    let number = strangers.len();
    // One that was there before, and one that comes now.
    known.enc_keys("sae-b").send().await.unwrap();
    client(dir.path(), addr).enc_keys("sae-b").send().await.unwrap();
    let grown = run.memory().saturating_sub(before);
    assert!(grown < 64 << 10, "{grown} KiB more with {number} connections");
    assert!(run.files() < 2000, "{} files", run.files());
    drop(strangers);
    client(dir.path(), addr).enc_keys("sae-b").send().await.unwrap();
    known.enc_keys("sae-b").send().await.unwrap();
}

/// A few more than there are places.
#[tokio::test]
async fn more_strangers_than_places_lock_out_no_known_client() {
    strangers_shut_nobody_out("", PLACES.div_ceil(CONNECTIONS)).await;
}

/// Without the connections that give way, the last stranger would wait until ten handshakes time out.
#[tokio::test]
#[ignore = "ten thousand connections: cargo test -p etsi-qkd014 --test sim_connections -- --ignored"]
async fn ten_thousand_strangers_lock_out_no_known_client() {
    strangers_shut_nobody_out("", 40).await;
}

#[tokio::test]
async fn nor_do_a_thousand_where_the_system_allows_few_files() {
    strangers_shut_nobody_out("ulimit -n 256;", 4).await;
}

#[tokio::test]
async fn clients_that_left_do_not_keep_their_places() {
    let dir = tempfile::tempdir().unwrap();
    let faults = ["silence,on=status", "lying-length,on=enc_keys", "latency=86400000,on=dec_keys"];
    let faults = faults.map(|fault| format!("--fault=kme-a:{fault}"));
    let (run, addr) = Killed::start(dir.path(), "", &faults.each_ref().map(String::as_str));
    let before = run.files();
    for call in 0..30 {
        let client = client(dir.path(), addr);
        let call = async {
            match call % 3 {
                0 => drop(client.status("sae-b").await),
                1 => drop(client.enc_keys("sae-b").send().await),
                _ => drop(
                    client
                        .dec_keys("sae-b")
                        .key_id("bc490419-7d60-487f-adc1-4ddcc177c139")
                        .send()
                        .await,
                ),
            }
        };
        // It has been asked by then, or is about to be.
        let _ = tokio::time::timeout(Duration::from_millis(150), call).await;
    }
    let deadline = Instant::now() + MINUTE;
    while run.files() > before {
        assert!(Instant::now() < deadline, "{} files, {before} before", run.files());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
