use axon_envelope::{Kind, TopicHash};
use quinn::Connection;

use super::{stream::Stream, *};
use crate::{
    gateway::{
        played::{Pair, block_on},
        queue::Offered,
    },
    session::MessageInfo,
};

const OF: Gid = Gid([7; 16]);

fn flow() -> Flow {
    let route = Route { kind: Kind::Topic, topic: TopicHash::new(0, "/t", "T").unwrap() };
    Flow { number: 1, route, acknowledged: false }
}

/// What the streams to a peer share that is at the other end of `connection`, and what must outlive it.
fn shared(connection: &Connection) -> (Arc<Shared>, watch::Sender<Carrier>) {
    let (connection, protection) = (connection.clone(), Protection::Link);
    let in_use = watch::channel(()).1;
    let (sender, carrier) = watch::channel(Carrier { connection, protection, in_use });
    let (popped, ended) = (Notify::new(), AtomicBool::new(false));
    let (counters, queues) = (Arc::default(), Room::new(256 << 20).of_peer());
    let done = Mutex::default();
    (Arc::new(Shared { carrier, counters, queues, popped, ended, done }), sender)
}

fn a_sample(sequence: u64) -> Sample {
    let info = MessageInfo {
        publisher: OF,
        sequence,
        source_timestamp: 0,
        received_timestamp: 0,
        reception: sequence,
    };
    sample(info, b"sample".to_vec())
}

/// The next stream, read to its end: whether it is reliable, and how many bytes follow its header.
async fn arrived(there: &Connection) -> (bool, usize) {
    let mut stream = there.accept_uni().await.unwrap();
    let bytes = stream.read_to_end(1 << 20).await.unwrap();
    (bytes[0] == 1, bytes.len() - 24)
}

async fn until_over(shared: &Shared) {
    while !shared.ended.swap(false, Ordering::Relaxed) {
        shared.popped.notified().await;
    }
}

fn queued(offered: Offered) {
    assert!(matches!(offered, Offered::Queued { dropped: 0 }), "{offered:?}");
}

#[test]
fn each_sample_goes_as_whoever_asks_for_most_wants_it() {
    block_on(async {
        let pair = Pair::new().await;
        let (shared, _carrier) = shared(&pair.here);
        let (lossy, whole) = (Qos::sensor_data(), Qos::keep_all());
        let stream = Stream::new(flow(), OF, &lossy, Arc::clone(&shared));
        queued(stream.offer(a_sample(1), &lossy));
        let (reliable, one) = arrived(&pair.there).await;
        assert!(!reliable);
        queued(stream.offer(a_sample(2), &whole));
        queued(stream.offer(a_sample(3), &whole));
        let mut sent = pair.there.accept_uni().await.unwrap();
        let mut bytes = vec![0; 24 + 2 * one];
        sent.read_exact(&mut bytes).await.unwrap();
        assert_eq!(bytes[0], 1);
        // The peer reads one after the other: the reliable one is at its end.
        queued(stream.offer(a_sample(4), &lossy));
        assert!(sent.read_to_end(1).await.unwrap().is_empty());
        assert_eq!(arrived(&pair.there).await, (false, one));
    });
}

#[test]
fn one_that_sends_no_more_leaves_nothing_behind() {
    block_on(async {
        let pair = Pair::new().await;
        let (shared, _carrier) = shared(&pair.here);
        for qos in [Qos::keep_all(), Qos::sensor_data()] {
            let mut feeds = HashMap::from([(OF, Feed::new(OF))]);
            let feed = feeds.get_mut(&OF).unwrap();
            queued(feed.queue(a_sample(1), &qos, flow(), &shared));
            assert!(feed.is_in_use());
            let sources = Vec::new();
            let seen = HashMap::new();
            let (flow, topic) = (flow(), "/t".into());
            let mut active = Active { flow, topic, stalled: false, sources, seen, feeds };
            active.prune();
            assert_eq!(active.feeds.len(), 1, "something is sent");
            arrived(&pair.there).await;
            until_over(&shared).await;
            active.prune();
            assert!(active.feeds.is_empty());
        }
    });
}

#[test]
fn what_comes_when_a_stream_is_over_has_another() {
    block_on(async {
        let pair = Pair::new().await;
        let (shared, _carrier) = shared(&pair.here);
        let mut feed = Feed::new(OF);
        for sequence in 1..=2 {
            queued(feed.queue(a_sample(sequence), &Qos::keep_all(), flow(), &shared));
            assert!(arrived(&pair.there).await.0);
            until_over(&shared).await;
            assert!(!feed.is_in_use());
        }
    });
}
