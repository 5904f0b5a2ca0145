//! Searches the memory of a daemon for a connection whose secrets are known: while the connection stands, and after its
//! end, when nothing may be left.

use std::{
    thread,
    time::{Duration, Instant},
};

use axon_tests::{
    memory::{Find, Needles, Stopped},
    unexpected,
};
use quinn::{Connection, Endpoint, RecvStream, SendStream};

use super::process::PATIENCE;

/// Sends a part of HELLO, and waits until the daemon has read it and answered. The streams keep the link from its end.
pub(crate) async fn begin_hello(connection: &Connection) -> (SendStream, RecvStream) {
    let (mut send, receive) = connection.open_bi().await.unwrap();
    send.write_all(&[0]).await.unwrap();
    tokio::time::sleep(Duration::from_millis(300)).await;
    (send, receive)
}

/// Waits until a daemon that dialled has sent a part of HELLO, and has read that the handshake is complete. It waits for an
/// answer as long as the streams are kept, but no longer than five seconds.
pub(crate) async fn hear_hello(connection: &Connection) -> (SendStream, RecvStream) {
    let (send, mut receive) = connection.accept_bi().await.unwrap();
    receive.read_exact(&mut [0]).await.unwrap();
    tokio::time::sleep(Duration::from_millis(300)).await;
    (send, receive)
}

/// Closes a connection, and waits until its end is sent.
pub(crate) async fn close(endpoint: &Endpoint, connection: &Connection) {
    connection.close(0_u32.into(), b"done");
    endpoint.wait_idle().await;
}

/// Searches a process, none of whose stacks may hold a part of a secret.
pub(crate) fn search(pid: u32, needles: &Needles) -> Vec<Find> {
    let found = Stopped::new(pid).unwrap().search(needles).unwrap();
    assert!(!found.iter().any(|find| find.on_stack), "parts of secrets on stacks: {found:?}");
    found
}

/// Searches until nothing is found. A connection that was closed waits for late packets, or is closed when it was idle.
pub(crate) fn wait_until_nowhere(name: &str, search: impl Fn() -> Vec<Find>) {
    let deadline = Instant::now() + PATIENCE;
    while unexpected("the daemon", &search(), |_| false) > 0 {
        assert!(
            Instant::now() < deadline,
            "{name}: parts of secrets are left of a connection that ended"
        );
        thread::sleep(Duration::from_millis(500));
    }
}
