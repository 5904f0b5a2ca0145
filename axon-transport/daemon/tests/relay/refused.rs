//! Endpoints that the daemon refuses.

use std::collections::BTreeSet;

use super::*;

/// Nodes that a relayed session may have.
const MOST: usize = 1024;

#[test]
fn refused_endpoints_are_in_no_graph_and_offered_to_the_next_daemon() {
    let host = host();
    let mut daemon = host.daemon();
    let (witness, own) = (session(&host, "witness", true), session(&host, "own", false));
    let shown = |by: &Session| by.graph().endpoints.keys().copied().collect::<BTreeSet<_>>();
    let node = |number| own.create_node(&format!("n{number}"), "/", "/").unwrap();
    let mut nodes: Vec<_> = (0..=MOST).map(node).collect();
    until("one too many is not shown", || shown(&own).len() == MOST);
    until("both see the same", || shown(&own) == shown(&witness));

    let accepted = nodes.iter().position(|node| shown(&own).contains(&node.gid())).unwrap();
    nodes.remove(accepted);
    until("it is gone", || shown(&own).len() == MOST - 1 && shown(&own) == shown(&witness));
    daemon.0.kill().unwrap();
    daemon.0.wait().unwrap();
    daemon = host.daemon();
    let all: BTreeSet<Gid> = nodes.iter().map(|node| node.gid()).collect();
    until("the next one takes all", || shown(&own) == all && shown(&witness) == all);
    drop(daemon);
}
