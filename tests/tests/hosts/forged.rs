//! Beacons and goodbyes that somebody else forges, while two real daemons look for each other.

use std::{
    net::{Ipv4Addr, SocketAddr, UdpSocket},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use axon_daemon::internal::wire::{
    SecurityTerms,
    beacon::{Beacon, Datagram},
};
use axon_transport::{ids::DaemonId, status::Status};

use super::{
    mode::{Settings, classic, pinned},
    pair::{Host, Plan},
    process::until,
};

/// Forged addresses.
const SOURCES: u8 = 200;

/// Sends datagrams to both hosts until it is dropped.
struct Forger {
    over: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    thread: Option<thread::JoinHandle<()>>,
}

/// The daemon in whose name something is forged, once it is known.
type Name = Arc<Mutex<Option<DaemonId>>>;

/// The kind of forgery, with `AXON_CLASSIC_AUTH` as beacons contain it.
#[derive(Clone)]
enum Forged {
    /// Beacons of daemons that there are not.
    MadeUp(u8),
    /// The same beacons, each from an address of its own.
    Scattered(u8),
    /// Beacons of a real daemon, from addresses where it is not.
    Beacons(u8, Name),
    /// Goodbyes of a real daemon, from its address, that of host B.
    Goodbyes(Name),
}

impl Forged {
    /// Returns the datagram of this number, as if it came from `address`.
    fn datagram(&self, domain: u32, number: u64, address: SocketAddr) -> Option<Datagram> {
        let mut id = [if number.is_multiple_of(2) { 0x11 } else { 0xee }; 16];
        id[1..9].copy_from_slice(&number.to_be_bytes());
        let (auth, daemon) = match self {
            Self::MadeUp(auth) | Self::Scattered(auth) => (*auth, DaemonId(id)),
            Self::Beacons(auth, name) => (*auth, (*name.lock().unwrap())?),
            Self::Goodbyes(name) => {
                let daemon = (*name.lock().unwrap())?;
                return Some(Datagram::Goodbye { domain, daemon });
            }
        };
        Some(Datagram::Beacon(Beacon {
            protocols: (1, 1),
            domain,
            daemon,
            terms: SecurityTerms { mode: 0, key_mode: 0, kex: 0, cipher: 0, auth: Some(auth) },
            sae: None,
            port: address.port(),
            addresses: vec![address.ip()],
            graph: number,
            answer_wanted: true,
            localhost: false,
        }))
    }
}

impl Forger {
    fn new(hosts: &[Host; 2], forged: Forged, a_second: u32) -> Self {
        let [a, b, c, _] = hosts[0].address.octets();
        let own = hosts.each_ref().map(|host| host.address);
        let elsewhere = (0..SOURCES).map(|last| Ipv4Addr::new(a, b, c, last));
        let elsewhere = elsewhere.filter(|address| !own.contains(address));
        let addresses: Vec<_> = match forged {
            Forged::Goodbyes(_) => vec![own[1]],
            // The hosts' own are in other networks.
            Forged::Scattered(_) => Vec::new(),
            Forged::MadeUp(_) | Forged::Beacons(..) => elsewhere.collect(),
        };
        let bind = move |address: &Ipv4Addr| UdpSocket::bind((*address, 0)).unwrap();
        let sources: Vec<_> = addresses.iter().map(bind).collect();
        let domain = hosts[0].domain();
        let port = 61_300 + 16 * domain as u16;
        let targets = own.map(|address| SocketAddr::from((address, port)));
        let (over, sent) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let (until, count) = (Arc::clone(&over), Arc::clone(&sent));
        let thread = thread::spawn(move || {
            let begin = Instant::now();
            // Relaxed: the flag orders nothing else.
            while !until.load(Ordering::Relaxed) {
                let number = count.fetch_add(1, Ordering::Relaxed);
                let scattered = sources.is_empty().then(|| {
                    let [.., c, d] = (number as u16).to_be_bytes();
                    bind(&Ipv4Addr::new(a, 200 + b % 50, c, d))
                });
                let at = number as usize % sources.len().max(1);
                let source = scattered.as_ref().unwrap_or_else(|| &sources[at]);
                let address = source.local_addr().unwrap();
                if let Some(datagram) = forged.datagram(domain, number, address) {
                    for target in targets {
                        // An error means that no socket is bound there yet.
                        let _ = source.send_to(&datagram.encode(), target);
                    }
                }
                let due = Duration::from_secs(number + 1) / a_second;
                thread::sleep(due.saturating_sub(begin.elapsed()));
            }
        });
        Self { over, sent, thread: Some(thread) }
    }

    fn wait_for(&self, datagrams: u64) {
        let sent = self.sent.load(Ordering::Relaxed);
        let so_many = || self.sent.load(Ordering::Relaxed) >= sent + datagrams;
        until("the forger works", so_many);
    }
}

impl Drop for Forger {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        let ended = self.thread.take().map(thread::JoinHandle::join);
        assert!(thread::panicking() || matches!(ended, Some(Ok(()))));
    }
}

/// Returns whether each host has a link with the other's current daemon.
fn linked(hosts: &[Host; 2]) -> bool {
    let [a, b] = hosts.each_ref().map(Host::status);
    let has = |one: &Status, other: &Status| one.links.iter().any(|l| l.peer == other.daemon);
    has(&a, &b) && has(&b, &a)
}

/// Returns the processor time that the host's daemon has used.
fn processor_time(host: &Host) -> Duration {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", host.status().pid)).unwrap();
    let fields = stat.rsplit_once(") ").unwrap().1.split(' ');
    // utime and stime, in ticks of 10 ms (proc(5)).
    let ticks: u64 = fields.skip(11).take(2).map(|ticks| ticks.parse::<u64>().unwrap()).sum();
    Duration::from_millis(10 * ticks)
}

fn id_of(host: &Host) -> DaemonId {
    let id = host.status().daemon;
    let byte = |at: usize| u8::from_str_radix(&id[2 * at..][..2], 16).unwrap();
    DaemonId(std::array::from_fn(byte))
}

/// Starts both hosts, then restarts the first one. Each time they must link before the forger has sent `most` more
/// datagrams. The forger goes on from now on in the second host's name.
fn link(what: &str, hosts: &mut [Host; 2], name: &Name, most: u64, sent: impl Fn() -> u64) {
    for again in [false, true] {
        if again {
            hosts[0].daemon = None;
            until("its daemon has ended", || hosts[0].try_status().is_none());
            hosts[0].start();
        } else {
            hosts.iter_mut().for_each(Host::start);
        }
        let (begin, before) = (Instant::now(), sent());
        *name.lock().unwrap() = Some(id_of(&hosts[1]));
        until("they are linked", || linked(hosts));
        let (took, sent) = (begin.elapsed(), sent() - before);
        let how = if again { "once one started anew" } else { "from the start" };
        eprintln!("{what}: linked {took:?} after both stood, {how}");
        assert!(sent < most, "{what}: linked after {sent} more datagrams, {how}");
    }
}

/// Links hosts with the settings that `plan` gives them, under each kind of forgery.
fn link_through_forged(plan: impl Fn([Settings; 2]) -> Plan) {
    let dir = tempfile::tempdir().unwrap();
    let none = || [classic(&[]), classic(&[])];
    let pins = || pinned(dir.path(), [[true; 2]; 2]);
    let name = Name::default;
    for (what, settings, a_second, forged) in [
        ("300 a second of made-up daemons, none", none(), 300, Forged::MadeUp(0)),
        ("300 a second of made-up daemons, pinned", pins(), 300, Forged::MadeUp(1)),
        ("5,000 a second of made-up daemons, none", none(), 5_000, Forged::MadeUp(0)),
        ("5,000 a second of made-up daemons, pinned", pins(), 5_000, Forged::MadeUp(1)),
        ("5,000 a second, each of its own address, none", none(), 5_000, Forged::Scattered(0)),
        ("20 a second in a host's name, none", none(), 20, Forged::Beacons(0, name())),
        ("5,000 a second in a host's name, none", none(), 5_000, Forged::Beacons(0, name())),
        ("5,000 a second in a host's name, pinned", pins(), 5_000, Forged::Beacons(1, name())),
        ("20 a second in a host's name, pinned", pins(), 20, Forged::Beacons(1, name())),
        ("20 goodbyes a second from its address, none", none(), 20, Forged::Goodbyes(name())),
    ] {
        let mut hosts = plan(settings).prepare();
        let forger = Forger::new(&hosts, forged.clone(), a_second);
        forger.wait_for(u64::from(a_second));
        let name = match &forged {
            Forged::MadeUp(_) | Forged::Scattered(_) => Name::default(),
            Forged::Beacons(_, name) | Forged::Goodbyes(name) => Arc::clone(name),
        };
        // The limit is the number of datagrams in three seconds.
        let sent = || forger.sent.load(Ordering::Relaxed);
        link(what, &mut hosts, &name, 3 * u64::from(a_second), sent);
        // Forged datagrams take nothing from a link that stands.
        forger.wait_for(u64::from(a_second));
        let since = hosts[0].link().since;
        let (begin, before) = (Instant::now(), hosts.each_ref().map(processor_time));
        forger.wait_for(2 * u64::from(a_second));
        let spent = [0, 1].map(|host| processor_time(&hosts[host]) - before[host]);
        let share = spent.map(|spent| spent.as_secs_f64() / begin.elapsed().as_secs_f64());
        eprintln!("{what}: the daemons take {share:.3?} of a processor");
        assert_eq!(hosts[0].link().since, since, "{what}");
        drop(forger);
    }
    let mut hosts = plan(none()).prepare();
    link("nothing forged", &mut hosts, &Name::default(), 1, || 0);
}

#[test]
fn hosts_that_list_each_other_link_through_forged_beacons() {
    link_through_forged(Plan::new);
}

#[test]
fn unlisted_hosts_link_through_forged_beacons() {
    link_through_forged(|settings| Plan { listed: false, ..Plan::new(settings) });
}
