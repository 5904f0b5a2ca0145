//! Asks the processes at the end whether all is well.

use std::collections::{HashMap, HashSet};

use super::{
    host::{Ending, Player},
    round::Gone,
};

/// A reader may give up memory that a killed daemon could have passed on, if the daemon was killed at most this many
/// milliseconds before: the reader waits ten seconds, and may be stopped for four.
const DAEMON: u128 = 15_000;

/// Milliseconds after one gap within which a reader may give up the next one of the same dead process: it waits one
/// second more, may be stopped for four, and the machine is busy.
const NEXT_GAP: u128 = 6_000;

/// The first number is how many milliseconds before its end a process may have had no daemon to report its readers'
/// losses to: it waits two seconds, and announces its end some time before. The second is how many milliseconds after
/// the end the daemon that got the report may have been killed before it told the readers: they may be stopped for four
/// seconds, and then have to connect to that daemon.
const UNTOLD: [u128; 2] = [5_000, 15_000];

/// The history of endpoints that are gone.
#[derive(Default)]
pub(super) struct Past {
    /// The time at which the process of each KEEP_ALL reader was killed, in milliseconds since the epoch.
    pub(super) deaths: HashMap<String, u128>,
    /// The publishers that ended.
    pub(super) ended: Vec<Ended>,
    /// The time at which processes ended, by session, in milliseconds since the epoch.
    pub(super) ends: HashMap<String, u128>,
    /// The times at which daemons were killed, in milliseconds since the epoch.
    pub(super) daemons: Vec<u128>,
}

impl Past {
    /// Returns whether a daemon was killed shortly before a reader gave something up.
    fn lost_daemon(&self, given_up: u128) -> bool {
        let shortly = given_up.saturating_sub(DAEMON)..=given_up;
        self.daemons.iter().any(|killed| shortly.contains(killed))
    }

    /// Records that a process ends now.
    pub(super) fn process_ends(&mut self, gid: &str, now: u128) {
        self.ends.insert(session(gid).to_owned(), now);
    }

    /// Returns whether no process was left to tell a reader what it lost of a publisher. The publisher's process has
    /// ended, and either the one daemon that it told has, too, or there was no daemon to tell. A living process tells
    /// every daemon.
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
    /// The readers that were matched before it published its last sample.
    readers: HashSet<String>,
}

impl Ended {
    pub(super) fn gid(&self) -> &str {
        &self.gid
    }

    /// Parses the report of a process about it.
    pub(super) fn parse(line: &str) -> Self {
        let mut words = line.split_ascii_whitespace().map(str::to_owned);
        let mut word = || words.next().expect("a GID and a number");
        Self { gid: word(), last: word(), readers: words.collect() }
    }
}

/// Returns the session of an endpoint: a GID begins with the id of its session.
fn session(gid: &str) -> &str {
    &gid[..24]
}

/// Checks that every process gets the last samples of every other, and of the publishers that ended, and that every
/// call is answered.
///
/// Returns how many pairs of a reader and an ended publisher never came about, although the publisher counted the
/// reader. In such a pair, the daemon was killed before it told the reader, and the publisher ended before the next
/// daemon matched them. The first number counts pairs whose reader counts the samples as lost. The second counts pairs
/// whose reader no process could tell.
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
    // The samples that a process left are lost with it if it was killed later.
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

/// Collects the missing messages. A KEEP_ALL subscription must not miss a sample of a living publisher, and must count
/// the samples that it misses of a dead one. Servers and clients must not miss a message of a living peer. The messages
/// of a process that ended by itself must arrive, too, unless a daemon was killed: that daemon may have held the
/// memory.
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
        // The time at which this reader last gave up a gap in memory that a killed daemon may have held, by publisher.
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

/// Makes the process at `index` print its log of `other`, and the process of `other` its log of `own`. Returns whether
/// the latter process exists.
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
