//! Peers that are not allowed.

use super::{
    mode::{Kmes, pinned},
    pair::Plan,
};

#[test]
fn a_peer_that_is_not_in_the_list_is_refused() {
    let kmes = Kmes::start();
    let strict = kmes.settings(1, &[("AXON_QKD_PEERS", "somebody-else")]);
    let [a, b] = Plan::new([kmes.settings(0, &[]), strict]).start();
    b.wait_refusal("B says whom it does not take", |text| {
        text.contains("sae-a") && text.contains("AXON_QKD_PEERS")
    });
    a.wait_refusal("A says that it is not taken", |text| text.contains("sae-b"));
    for host in [a, b] {
        let links = host.status().links;
        assert!(links.is_empty(), "{links:?}");
    }
    // Neither was brought to spend keys without end on it.
    let (new, _) = kmes.keys();
    assert!(new <= 8, "{new} keys for nothing");
}

#[test]
fn a_key_that_is_not_pinned_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    // A knows B, B does not know A.
    let hosts = Plan::new(pinned(dir.path(), [[false, true], [false, false]])).start();
    for host in &hosts {
        host.wait_refusal("a reason that speaks of trust", |text| text.contains("trust"));
    }
    for host in &hosts {
        let links = host.status().links;
        assert!(links.is_empty(), "{links:?}");
    }
}
