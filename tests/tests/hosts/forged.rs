//! Beacons that somebody else forges, while two real daemons look for each other.

use std::{
    net::{Ipv4Addr, SocketAddr, UdpSocket},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use axon_transport::{
    daemon::status::Status,
    discovery::{
        Terms,
        beacon::{Beacon, Datagram},
    },
    ids::DaemonId,
};

use super::{
    mode::{classic, pinned},
    pair::{Host, Plan},
    process::until,
};

/// Forged addresses.
const SOURCES: u8 = 200;

/// Sends beacons to both hosts until it is dropped.
struct Forger {
    over: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    thread: Option<thread::JoinHandle<()>>,
}

/// In whose names beacons are forged: of daemons that there are not, or of this one.
type Name = Arc<Mutex<Option<DaemonId>>>;

impl Forger {
    fn new(hosts: &[Host; 2], auth: u8, a_second: u32, name: Name) -> Self {
        let [a, b, c, _] = hosts[0].address.octets();
        let own = hosts.each_ref().map(|host| host.address);
        let sources: Vec<_> = (0..SOURCES)
            .map(|last| Ipv4Addr::new(a, b, c, last))
            .filter(|address| !own.contains(address))
            .map(|address| UdpSocket::bind((address, 0)).unwrap())
            .collect();
        let domain = hosts[0].domain();
        let port = 61_300 + 16 * domain as u16;
        let targets = own.map(|address| SocketAddr::from((address, port)));
        let (over, sent) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let (until, count) = (Arc::clone(&over), Arc::clone(&sent));
        let thread = thread::spawn(move || {
            let begin = Instant::now();
            // Relaxed: nothing else is told by it.
            while !until.load(Ordering::Relaxed) {
                let number = count.fetch_add(1, Ordering::Relaxed);
                let source = &sources[number as usize % sources.len()];
                let address = source.local_addr().unwrap();
                let mut id = [if number.is_multiple_of(2) { 0x11 } else { 0xee }; 16];
                id[1..9].copy_from_slice(&number.to_be_bytes());
                let datagram = Datagram::Beacon(Beacon {
                    protocols: (1, 1),
                    domain,
                    daemon: name.lock().unwrap().unwrap_or(DaemonId(id)),
                    terms: Terms { mode: 0, key_mode: 0, kex: 0, cipher: 0, auth: Some(auth) },
                    sae: None,
                    port: address.port(),
                    addresses: vec![address.ip()],
                    graph: number,
                    answer_wanted: true,
                    localhost: false,
                });
                for target in targets {
                    // An error: nobody is there yet.
                    let _ = source.send_to(&datagram.encode(), target);
                }
                let due = Duration::from_secs(number + 1) / a_second;
                thread::sleep(due.saturating_sub(begin.elapsed()));
            }
        });
        Self { over, sent, thread: Some(thread) }
    }

    fn wait_for(&self, beacons: u64) {
        until("the forger works", || self.sent.load(Ordering::Relaxed) >= beacons);
    }
}

impl Drop for Forger {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        let ended = self.thread.take().map(thread::JoinHandle::join);
        assert!(thread::panicking() || matches!(ended, Some(Ok(()))));
    }
}

/// Whether each has a link with the other's daemon as it is now.
fn linked(hosts: &[Host; 2]) -> bool {
    let [a, b] = hosts.each_ref().map(Host::status);
    let has = |one: &Status, other: &Status| one.links.iter().any(|l| l.peer == other.daemon);
    has(&a, &b) && has(&b, &a)
}

fn id_of(host: &Host) -> DaemonId {
    let id = host.status().daemon;
    let byte = |at: usize| u8::from_str_radix(&id[2 * at..][..2], 16).unwrap();
    DaemonId(std::array::from_fn(byte))
}

/// Starts both hosts, then the first one anew; each time they link, while the forger goes on.
fn link(what: &str, hosts: &mut [Host; 2], name: &Name) {
    for again in [false, true] {
        if again {
            hosts[0].daemon = None;
            until("its daemon has ended", || hosts[0].try_status().is_none());
            hosts[0].start();
        } else {
            hosts.iter_mut().for_each(Host::start);
        }
        let begin = Instant::now();
        if let Some(name) = &mut *name.lock().unwrap() {
            *name = id_of(&hosts[1]);
        }
        until("they are linked", || linked(hosts));
        let how = if again { "once one started anew" } else { "from the start" };
        eprintln!("{what}: linked {:?} after both stood, {how}", begin.elapsed());
    }
}

#[test]
fn hosts_that_list_each_other_link_through_forged_beacons() {
    let of_all = || Name::default();
    let of_one = || Name::new(Mutex::new(Some(DaemonId([0x5a; 16]))));
    let dir = tempfile::tempdir().unwrap();
    let none = || [classic(&[]), classic(&[])];
    let pins = || pinned(dir.path(), [[true; 2]; 2]);
    for (what, settings, auth, a_second, name) in [
        ("300 a second of made-up daemons, none", none(), 0, 300, of_all()),
        ("300 a second of made-up daemons, pinned", pins(), 1, 300, of_all()),
        ("20 a second in a host's name, none", none(), 0, 20, of_one()),
        ("20 a second in a host's name, pinned", pins(), 1, 20, of_one()),
    ] {
        let mut hosts = Plan::new(settings).prepare();
        let forger = Forger::new(&hosts, auth, a_second, Arc::clone(&name));
        forger.wait_for(u64::from(a_second));
        link(what, &mut hosts, &name);
        drop(forger);
    }
    let mut hosts = Plan::new(none()).prepare();
    link("nothing forged", &mut hosts, &of_all());
}
