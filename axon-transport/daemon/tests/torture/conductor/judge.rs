//! Asks the processes in the end whether all is well.

use std::collections::{HashMap, HashSet};

use super::{
    host::{Ending, Player},
    round::Gone,
};

/// How long before a reader gives up what it waits for a daemon may have been killed that could have handed it over, in
/// milliseconds: it waits for ten seconds, and may be stopped for four.
const DAEMON: u128 = 15_000;

/// How long after one gap a reader may give up the next one of the same dead process, in milliseconds: it waits for a
/// second more, may be stopped for four, and the machine is busy.
const NEXT_GAP: u128 = 6_000;

/// How long before its end a process may have had no daemon to tell what its readers lost: it waits for two seconds, and
/// says that it ends some time before it does. And how long after it the daemon may have been killed that it told, before
/// the readers were: they may be stopped for four seconds, and then have to come to that daemon.
const UNTOLD: [u128; 2] = [5_000, 15_000];

/// What happened to endpoints that are gone.
#[derive(Default)]
pub(super) struct Past {
    /// When the process of each KEEP_ALL reader was killed, in milliseconds since the epoch.
    pub(super) deaths: HashMap<String, u128>,
    /// Publishers that ended.
    pub(super) ended: Vec<Ended>,
    /// When processes ended, by their session, in milliseconds since the epoch.
    pub(super) ends: HashMap<String, u128>,
    /// When daemons were killed, in milliseconds since the epoch.
    pub(super) daemons: Vec<u128>,
}

impl Past {
    /// Whether a daemon was killed shortly before a reader gave something up.
    fn lost_daemon(&self, given_up: u128) -> bool {
        let shortly = given_up.saturating_sub(DAEMON)..=given_up;
        self.daemons.iter().any(|killed| shortly.contains(killed))
    }

    /// A process ends now.
    pub(super) fn process_ends(&mut self, gid: &str, now: u128) {
        self.ends.insert(session(gid).to_owned(), now);
    }

    /// Whether nobody was left to tell a reader what it lost of a publisher: its process has ended, and so has the one
    /// daemon that it told, or there was none that it could tell. As long as the process lives it tells every daemon.
    fn left_nobody(&self, publisher: &str) -> bool {
        let Some(end) = self.ends.get(session(publisher)) else { return false };
        let around = end.saturating_sub(UNTOLD[0])..=end + UNTOLD[1];
        self.daemons.iter().any(|killed| around.contains(killed))
    }
}

/// A KEEP_ALL publisher that ended.
pub(super) struct Ended {
    gid: String,
    last: String,
    /// Those that were matched before it published its last sample.
    readers: HashSet<String>,
}

impl Ended {
    pub(super) fn gid(&self) -> &str {
        &self.gid
    }

    /// What a process says of it.
    pub(super) fn parse(line: &str) -> Self {
        let mut words = line.split_ascii_whitespace().map(str::to_owned);
        let mut word = || words.next().expect("a GID and a number");
        Self { gid: word(), last: word(), readers: words.collect() }
    }
}

/// The session of an endpoint: a GID begins with that of its session.
fn session(gid: &str) -> &str {
    &gid[..24]
}

/// Every process must come to have the last samples of every other, and of those that ended. Every call must be
/// answered.
///
/// Returns how many pairs of a reader and a publisher that ended never came about, though the publisher counted the
/// reader: the daemon between them was killed before the reader was told, and the publisher ended before the next one
/// matched them. Of the first the reader counts the samples as lost. Of the others nobody could tell it.
pub(super) fn come_to_rest(players: &mut [Player], past: &mut Past) -> [u64; 2] {
    for player in players.iter_mut() {
        player.resume();
    }
    for player in players.iter_mut() {
        if let Some(ending) = player.ending.take() {
            assert!(ending == Ending::Publisher, "the process was not to play on");
            past.ended.push(Ended::parse(&player.hear()));
        }
        player.tell("quiet");
    }
    for index in 0..players.len() {
        let answer = players[index].ask("calls");
        if let Some((client, server)) = answer.split_once(' ') {
            let lives = print_pair(players, index, client, server);
            panic!("{client} waits for {server}, whose process lives: {lives}");
        }
    }
    let mut subscriptions = String::new();
    for player in players.iter_mut() {
        subscriptions += " ";
        subscriptions += &player.reader();
    }
    let mut lasts = Vec::new();
    for (index, player) in players.iter_mut().enumerate() {
        lasts.push((index, player.ask(&format!("final{subscriptions}"))));
    }
    // What a process left is gone with it if it was killed later.
    let killed: HashSet<&str> = past.deaths.keys().map(|reader| session(reader)).collect();
    past.ended.retain(|ended| !killed.contains(session(&ended.gid)));
    let (mut unmet, mut wrong) = ([0; 2], Vec::new());
    for player in players.iter_mut() {
        let reader = player.reader();
        for Ended { gid, last, readers } in &past.ended {
            if readers.contains(&reader) && session(gid) != session(&reader) {
                match player.ask(&format!("expect {gid} {last}")).as_str() {
                    "there" => {}
                    "counted" => unmet[0] += 1,
                    "never" if past.left_nobody(gid) => unmet[1] += 1,
                    answer => {
                        assert_eq!(answer, "never");
                        let ended = past.ends.get(session(gid));
                        wrong.push(format!("{reader} of {gid}, whose process ended: {ended:?}"));
                    }
                }
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "publishers that ended were neither met nor counted as lost:\n{}\ndaemons killed: {:?}",
        wrong.join("\n"),
        past.daemons
    );
    for (of, last) in &lasts {
        for (index, player) in players.iter_mut().enumerate() {
            // A publisher does not wait for subscriptions of its own session.
            if index != *of {
                assert_eq!(player.ask(&format!("expect {last}")), "there");
            }
        }
    }
    unmet
}

/// What did not come. KEEP_ALL subscriptions must not miss a sample of a publisher that lived, and must count those
/// that they missed of one that was dead by then. Servers and clients must not miss a message of one that lived. What a
/// process left that ended by itself must come, too, unless a daemon was killed: it may have held the memory.
pub(super) fn missed(players: &mut [Player], past: &Past) -> Gone {
    let deaths: HashMap<&str, u128> =
        past.deaths.iter().map(|(reader, at)| (session(reader), *at)).collect();
    let mut living = HashSet::new();
    for player in players.iter_mut() {
        living.insert(session(&player.reader()).to_owned());
    }
    let (mut gone, mut wrong) = (Gone::default(), Vec::new());
    for (index, player) in players.iter_mut().enumerate() {
        let answer = player.ask("missed");
        let words: Vec<&str> = answer.split_ascii_whitespace().collect();
        // When this reader last gave up a gap in memory that a killed daemon may have held, by publisher.
        let mut gaps: HashMap<&str, u128> = HashMap::new();
        for [partner, messages, at, what] in words.as_chunks::<4>().0 {
            let at: u128 = at.parse().expect("a time");
            let number: u64 = messages.parse().expect("a number");
            let with_daemon = !living.contains(session(partner))
                && (past.lost_daemon(at)
                    || gaps.get(partner).is_some_and(|last| at <= last + NEXT_GAP));
            if with_daemon {
                gaps.insert(partner, at);
            }
            let was_dead =
                deaths.get(session(partner)).is_some_and(|death| *death <= at) || with_daemon;
            match *what {
                "counted" if was_dead => gone.samples += number,
                "request" | "response" if was_dead => gone.calls += number,
                "unanswered" if !living.contains(session(partner)) => gone.calls += number,
                _ => {
                    let reader = player.reader();
                    let partner = (*partner).to_owned();
                    wrong.push((index, reader, partner, format!("{messages} ({what})")));
                }
            }
        }
    }
    for (index, reader, partner, _) in &wrong {
        print_pair(players, *index, reader, partner);
    }
    let describe = |(_, reader, partner, what): &(_, String, String, String)| {
        format!("{reader} missed {what} of {partner}")
    };
    let told: Vec<String> = wrong.iter().map(describe).collect();
    assert!(
        wrong.is_empty(),
        "messages of processes that live, or that nobody counts, are missing:\n{}",
        told.join("\n")
    );
    gone
}

/// Has the process at `index` print what it knows of `other`, and the process of that one what it knows of `own`.
/// Whether there is such a process.
fn print_pair(players: &mut [Player], index: usize, own: &str, other: &str) -> bool {
    players[index].ask(&format!("pair_log {other}"));
    let mut lives = false;
    for player in players.iter_mut() {
        if session(&player.reader()) == session(other) {
            player.ask(&format!("pair_log {own}"));
            lives = true;
        }
    }
    lives
}
