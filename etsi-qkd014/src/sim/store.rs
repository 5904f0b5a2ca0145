//! The key material that the KMEs of a network share, in place of a QKD link.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use zeroize::Zeroizing;

use crate::tls;

/// How fast a link makes keys.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum FillRate {
    /// The store is always full.
    Unlimited,
    /// This number of keys of the default size per second.
    PerSecond(f64),
}

/// Most keys that a master has and not all slaves; beyond it, the oldest is deleted.
const MAX_WAITING: usize = 65_536;

pub(super) struct Store {
    rate: FillRate,
    max_stored: u64,
    /// The keys in stock for each pair of KMEs, and the time of that count.
    links: HashMap<(usize, usize), (f64, Instant)>,
    initially: u64,
    waiting: HashMap<String, Waiting>,
    /// The IDs of `waiting`, in the order in which they were drawn.
    order: BTreeMap<u64, String>,
    drawn: u64,
    /// The keys drawn since the state was recorded, if it was.
    noted: Option<Vec<Noted>>,
    /// The keys that are drawn again, the oldest first.
    again: VecDeque<Noted>,
    witness: Witness,
}

/// A function that gets the key_ID and the secret of each key that is drawn.
#[derive(Clone, Default)]
pub(super) struct Witness(Option<Arc<Tell>>);

type Tell = dyn Fn(&str, &[u8]) + Send + Sync;

impl Witness {
    pub(super) fn new(tell: impl Fn(&str, &[u8]) + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(tell)))
    }
}

impl fmt::Debug for Witness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "a witness" } else { "no witness" })
    }
}

/// A key as it was drawn, with its master and slaves.
struct Noted {
    key: Drawn,
    master: String,
    slaves: BTreeSet<String>,
}

/// A key that slaves may still draw.
struct Waiting {
    /// Its number in the order of drawing.
    place: u64,
    secret: Zeroizing<Vec<u8>>,
    master: String,
    slaves: BTreeSet<String>,
}

pub(super) type Drawn = (String, Zeroizing<Vec<u8>>);

/// The reason why keys are not given to a slave.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// There is no such key, or this slave has had it.
    Unknown(Vec<String>),
    /// The key exists but is not for this pair of master and slave.
    NotYours,
}

impl Store {
    pub(super) fn new(rate: FillRate, max_stored: u64, initially: u64) -> Self {
        Self {
            rate,
            max_stored,
            links: HashMap::new(),
            initially: initially.min(max_stored),
            waiting: HashMap::new(),
            order: BTreeMap::new(),
            drawn: 0,
            noted: None,
            again: VecDeque::new(),
            witness: Witness::default(),
        }
    }

    pub(super) fn with_witness(self, witness: Witness) -> Self {
        Self { witness, ..self }
    }

    /// Records the state, for [`set_back`](Self::set_back).
    pub(super) fn note(&mut self) {
        self.noted = Some(Vec::new());
        self.again.clear();
    }

    /// Restores the recorded state: the keys drawn since then are drawn again.
    pub(super) fn set_back(&mut self) {
        self.again.extend(self.noted.replace(Vec::new()).unwrap_or_default());
    }

    /// Returns the next key for `master` and `slaves`.
    fn next_key(&mut self, bytes: usize, master: &str, slaves: &BTreeSet<String>) -> Drawn {
        let fits = |noted: &Noted| {
            noted.master == master && noted.slaves == *slaves && noted.key.1.len() == bytes
        };
        let before = self.again.iter().position(fits).and_then(|i| self.again.remove(i));
        let key = before.map_or_else(
            || {
                let mut secret = Zeroizing::new(vec![0; bytes]);
                random(&mut secret);
                (uuid(), secret)
            },
            |noted| noted.key,
        );
        if let Some(noted) = &mut self.noted {
            let (master, slaves) = (master.to_owned(), slaves.clone());
            noted.push(Noted { key: key.clone(), master, slaves });
        }
        key
    }

    /// Returns the number of keys in stock between two KMEs now.
    pub(super) fn stored(&mut self, a: usize, b: usize) -> u64 {
        *self.level(a, b) as u64
    }

    fn level(&mut self, a: usize, b: usize) -> &mut f64 {
        let now = Instant::now();
        let max = self.max_stored as f64;
        let start = (self.initially as f64, now);
        let (level, at) = self.links.entry((a.min(b), a.max(b))).or_insert(start);
        *level = match self.rate {
            FillRate::Unlimited => max,
            FillRate::PerSecond(rate) => (*level + rate * (now - *at).as_secs_f64()).min(max),
        };
        *at = now;
        level
    }

    /// Draws `number` fresh keys of `bytes` each, at `cost` from the stock of every link that
    /// carries them. Returns `None`, and spends nothing, if one link does not have that much.
    pub(super) fn draw(
        &mut self,
        links: &BTreeSet<(usize, usize)>,
        number: u64,
        bytes: usize,
        cost: u64,
        master: &str,
        slaves: &BTreeSet<String>,
    ) -> Option<Vec<Drawn>> {
        if links.iter().any(|&(a, b)| *self.level(a, b) < cost as f64) {
            return None;
        }
        for &(a, b) in links {
            *self.level(a, b) -= cost as f64;
        }
        let mut drawn = Vec::new();
        for _ in 0..number {
            let (id, secret) = self.next_key(bytes, master, slaves);
            if let Some(tell) = &self.witness.0 {
                tell(&id, &secret);
            }
            let (master, slaves) = (master.to_owned(), slaves.clone());
            self.drawn += 1;
            let waiting = Waiting { place: self.drawn, secret: secret.clone(), master, slaves };
            self.waiting.insert(id.clone(), waiting);
            self.order.insert(self.drawn, id.clone());
            drawn.push((id, secret));
        }
        while self.order.len() > MAX_WAITING {
            if let Some((_, oldest)) = self.order.pop_first() {
                self.waiting.remove(&oldest);
            }
        }
        Some(drawn)
    }

    /// Gives keys to a slave, each once unless they are to be kept (`keep`). Gives either all of
    /// them or none.
    pub(super) fn give(
        &mut self,
        ids: &[String],
        master: &str,
        slave: &str,
        keep: bool,
    ) -> Result<Vec<Drawn>, Refusal> {
        let folded: Vec<String> = ids.iter().map(|id| id.to_ascii_lowercase()).collect();
        if folded.iter().collect::<BTreeSet<_>>().len() < folded.len() {
            return Err(Refusal::Unknown(ids.to_vec()));
        }
        let mut unknown = Vec::new();
        for id in &folded {
            match self.waiting.get(id) {
                Some(key) if key.master == master && key.slaves.contains(slave) => {}
                Some(_) => return Err(Refusal::NotYours),
                None => unknown.push(id.clone()),
            }
        }
        if !unknown.is_empty() {
            return Err(Refusal::Unknown(unknown));
        }
        let given = folded.into_iter().filter_map(|id| {
            let key = self.waiting.get_mut(&id)?;
            let secret = key.secret.clone();
            if !keep {
                key.slaves.remove(slave);
            }
            if key.slaves.is_empty() {
                self.order.remove(&key.place);
                self.waiting.remove(&id);
            }
            Some((id, secret))
        });
        Ok(given.collect())
    }
}

fn random(bytes: &mut [u8]) {
    tls::provider().secure_random.fill(bytes).expect("the system's random number generator works");
}

/// Returns a random UUID, version 4 (RFC 9562, 5.4).
pub(super) fn uuid() -> String {
    let mut bytes = [0; 16];
    random(&mut bytes);
    bytes[6] = bytes[6] & 0x0f | 0x40;
    bytes[8] = bytes[8] & 0x3f | 0x80;
    let mut text = String::with_capacity(36);
    for (at, byte) in bytes.iter().enumerate() {
        if matches!(at, 4 | 6 | 8 | 10) {
            text.push('-');
        }
        text.push_str(&format!("{byte:02x}"));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slaves(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    fn link(a: usize, b: usize) -> BTreeSet<(usize, usize)> {
        BTreeSet::from([(a, b)])
    }

    #[test]
    fn only_named_slaves_get_a_key_and_each_only_once() {
        let mut store = Store::new(FillRate::Unlimited, 10, 10);
        let drawn = store.draw(&link(0, 1), 1, 32, 1, "m", &slaves(&["s", "t"])).unwrap();
        let ids = [drawn[0].0.clone()];
        assert_eq!(store.give(&ids, "m", "x", false).unwrap_err(), Refusal::NotYours);
        assert_eq!(store.give(&ids, "x", "s", false).unwrap_err(), Refusal::NotYours);
        assert_eq!(store.give(&ids, "m", "s", false).unwrap(), drawn);
        assert!(store.give(&ids, "m", "s", false).is_err());
        assert_eq!(store.give(&ids, "m", "t", false).unwrap(), drawn);
        assert!(matches!(store.give(&ids, "m", "t", false), Err(Refusal::Unknown(_))));
    }

    #[test]
    fn a_refused_batch_gives_and_consumes_nothing() {
        let mut store = Store::new(FillRate::Unlimited, 10, 10);
        let drawn = store.draw(&link(0, 1), 1, 32, 1, "m", &slaves(&["s"])).unwrap();
        let id = drawn[0].0.clone();
        assert!(store.give(&[id.clone(), uuid()], "m", "s", false).is_err());
        assert!(store.give(&[id.clone(), id.to_uppercase()], "m", "s", false).is_err());
        assert!(store.give(&[id], "m", "s", false).is_ok());
    }

    #[test]
    fn delivered_keys_leave_no_entries() {
        let mut store = Store::new(FillRate::Unlimited, 10, 10);
        let first = store.draw(&link(0, 1), 1, 32, 1, "m", &slaves(&["s"])).unwrap();
        // More keys than may wait, but none of these waits.
        for _ in 0..MAX_WAITING / 64 + 1 {
            let drawn = store.draw(&link(0, 1), 64, 32, 1, "m", &slaves(&["s", "t"])).unwrap();
            let ids: Vec<_> = drawn.into_iter().map(|(id, _)| id).collect();
            for slave in ["s", "t"] {
                store.give(&ids, "m", slave, false).unwrap();
            }
        }
        assert_eq!((store.waiting.len(), store.order.len()), (1, 1));
        assert_eq!(store.give(std::slice::from_ref(&first[0].0), "m", "s", false).unwrap(), first);
        assert_eq!((store.waiting.len(), store.order.len()), (0, 0));
    }

    #[test]
    fn the_oldest_unfetched_key_is_wiped_when_too_many_wait() {
        let mut store = Store::new(FillRate::Unlimited, 10, 10);
        let first = store.draw(&link(0, 1), 2, 32, 1, "m", &slaves(&["s"])).unwrap();
        for _ in 0..(MAX_WAITING - 1) / 5 {
            store.draw(&link(0, 1), 5, 32, 1, "m", &slaves(&["s"])).unwrap();
        }
        assert_eq!((store.waiting.len(), store.order.len()), (MAX_WAITING, MAX_WAITING));
        let [(gone, _), (kept, _)] = first.try_into().unwrap();
        let refused = store.give(std::slice::from_ref(&gone), "m", "s", false);
        assert_eq!(refused, Err(Refusal::Unknown(vec![gone])));
        assert!(store.give(&[kept], "m", "s", false).is_ok());
    }

    #[test]
    fn a_key_that_is_kept_is_given_again() {
        let mut store = Store::new(FillRate::Unlimited, 10, 10);
        let drawn = store.draw(&link(0, 1), 1, 32, 1, "m", &slaves(&["s"])).unwrap();
        let ids = [drawn[0].0.clone()];
        assert_eq!(store.give(&ids, "m", "s", true).unwrap(), drawn);
        assert_eq!(store.give(&ids, "m", "s", false).unwrap(), drawn);
        assert!(store.give(&ids, "m", "s", false).is_err());
    }

    #[test]
    fn restored_store_delivers_the_same_keys_to_the_same_saes() {
        let mut store = Store::new(FillRate::Unlimited, 10, 10);
        let draw = |store: &mut Store, slave: &str| {
            store.draw(&link(0, 1), 2, 32, 2, "m", &slaves(&[slave])).unwrap()
        };
        let before = draw(&mut store, "s");
        store.note();
        let [first, other] = ["s", "t"].map(|slave| draw(&mut store, slave));
        assert!(first != before);
        store.set_back();
        assert_eq!(draw(&mut store, "t"), other);
        assert_eq!(draw(&mut store, "s"), first);
        assert!(store.give(std::slice::from_ref(&first[0].0), "m", "s", false).is_ok());
        assert!(draw(&mut store, "s") != first, "nothing more was drawn then");
    }

    #[test]
    fn a_store_that_does_not_fill_runs_out() {
        let mut store = Store::new(FillRate::PerSecond(0.0), 10, 3);
        assert!(store.draw(&link(0, 1), 4, 32, 4, "m", &slaves(&["s"])).is_none());
        assert!(store.draw(&link(0, 1), 3, 32, 3, "m", &slaves(&["s"])).is_some());
        assert_eq!(store.stored(1, 0), 0);
        assert_eq!(store.stored(0, 2), 3, "another link has its own stock");
    }

    #[test]
    fn a_key_for_several_links_spends_the_stock_of_each_or_of_none() {
        let mut store = Store::new(FillRate::PerSecond(0.0), 10, 3);
        let both = BTreeSet::from([(0, 1), (0, 2)]);
        assert!(store.draw(&both, 2, 32, 2, "m", &slaves(&["s", "t"])).is_some());
        assert_eq!((store.stored(0, 1), store.stored(0, 2)), (1, 1));
        assert!(store.draw(&link(0, 1), 1, 32, 1, "m", &slaves(&["s"])).is_some());
        assert!(store.draw(&both, 1, 32, 1, "m", &slaves(&["s", "t"])).is_none());
        assert_eq!((store.stored(0, 1), store.stored(0, 2)), (0, 1));
    }

    #[test]
    fn uuids_are_version_4() {
        let id = uuid();
        assert_eq!((id.len(), id.as_bytes()[14]), (36, b'4'));
        assert!(matches!(id.as_bytes()[19], b'8' | b'9' | b'a' | b'b'));
    }
}
