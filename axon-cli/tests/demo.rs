//! The demo, whole and sped up: every route delivers every byte of the robot's log, and every
//! wrong peer is refused for its own fault.

#![forbid(unsafe_code)]

mod common;

use common::{Stderr, axon};
use serde_json::Value;

#[test]
fn every_route_delivers_and_every_wrong_peer_is_refused() {
    let temporary = tempfile::tempdir().expect("a temporary directory");
    let output = axon([("TMPDIR", temporary.path().to_str().expect("UTF-8"))])
        .args(["demo", "--json", "--rate", "400"])
        .output()
        .expect("the demo starts");
    let errors = Stderr::of(&output.stderr);
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("no report: {e}; standard error:\n{errors}"));
    assert_eq!(report["passed"], true, "{report:#}\n{errors}");
    assert!(output.status.success());

    let routes = report["routes"].as_array().expect("routes");
    let negotiated: Vec<_> = routes.iter().map(|r| r["key_exchange"].as_str()).collect();
    assert_eq!(negotiated, [None, Some("X25519MLKEM768"), Some("psk_ke"), Some("psk_ke")]);
    for route in routes {
        assert_eq!(route["messages"], 5964, "{route:#}");
        assert_eq!(route["bytes"], 4_628_064, "{route:#}");
        for fault in ["lost", "out_of_order", "duplicates", "different"] {
            assert_eq!(route[fault], 0, "{fault}: {route:#}");
        }
    }
    // Ten messages a key at most.
    let keys = routes[3]["kme_keys"]["to_slaves"].as_u64().expect("KME keys");
    assert!(keys >= 597, "{keys} keys for 5,964 messages");

    let peers = report["wrong_peers"].as_array().expect("wrong peers");
    assert_eq!(peers.len(), 8);
    for peer in peers {
        assert_eq!(peer["refused"], true, "{peer:#}");
    }
    let left = std::fs::read_dir(temporary.path()).expect("the temporary directory").count();
    assert_eq!(left, 0, "the demo left files behind");
}
