//! Tests HELLO, and the order of messages.

use super::*;
use crate::wire::{
    keys::KeyMessage,
    link::samples::{elected, hello, key_id, messages, peer},
};

#[test]
fn a_hello_that_differs_is_refused_by_name() {
    let ours = hello();
    assert_eq!(check(&ours, &peer(), Some("sae-b")), Ok(()));
    let claimed = check(&ours, &peer(), None).unwrap_err();
    assert_eq!(claimed.code, CloseCode::Sae, "an SAE that no PSK names");
    let cases: [(LinkHello, CloseCode); 9] = [
        (LinkHello { protocol_min: 2, protocol_max: 3, ..peer() }, CloseCode::Protocol),
        (LinkHello { daemon: ours.daemon, ..peer() }, CloseCode::Self_),
        (LinkHello { domain: 5, ..peer() }, CloseCode::Domain),
        (LinkHello { mode: 0, ..peer() }, CloseCode::Mode),
        (LinkHello { key_mode: 1, ..peer() }, CloseCode::KeyMode),
        (LinkHello { kex: 2, ..peer() }, CloseCode::Kex),
        (LinkHello { cipher: 200, ..peer() }, CloseCode::Cipher),
        (LinkHello { auth: Some(0), ..peer() }, CloseCode::Auth),
        (LinkHello { sae: Some("sae-c".into()), ..peer() }, CloseCode::Sae),
    ];
    for (theirs, code) in cases {
        assert_eq!(check(&ours, &theirs, Some("sae-b")).unwrap_err().code, code);
    }
}

#[test]
fn nothing_precedes_hello_proof_and_election() {
    let others: Vec<_> = messages().into_iter().skip(1).collect();
    for side in [Side::Client, Side::Server] {
        let mut order = MessageOrder::new(side, true);
        for m in &others {
            assert!(order.accept(m).is_err(), "{} before HELLO", m.name());
        }
        order.accept(&messages()[0]).unwrap();
        assert!(order.accept(&messages()[0]).is_err(), "a second HELLO");
        order.hello_checked(true);
        for m in &others {
            let proof = match side {
                Side::Client => matches!(m, LinkMessage::Keys(KeyMessage::Announce(_))),
                Side::Server => {
                    matches!(
                        m,
                        LinkMessage::Keys(KeyMessage::Ready { .. } | KeyMessage::Failed { .. })
                    )
                }
            };
            let allowed = proof || matches!(m, LinkMessage::Keepalive);
            assert_eq!(order.accept(m).is_ok(), allowed, "{} before the proof", m.name());
        }
        order.proven();
        assert!(order.accept(&LinkMessage::Graph(GraphUpdate::default())).is_err());
        order.accept(&elected()).unwrap();
        order.elected();
        order.accept(&LinkMessage::Graph(GraphUpdate::default())).unwrap();
        assert!(order.accept(&elected()).is_err(), "a second ELECTED");
    }
}

#[test]
fn the_higher_id_cannot_elect_and_classic_knows_no_keys() {
    let mut order = MessageOrder::new(Side::Server, false);
    order.accept(&messages()[0]).unwrap();
    order.hello_checked(false);
    assert!(order.accept(&elected()).is_err());
    order.elected();
    assert!(order.accept(&LinkMessage::Keys(KeyMessage::Announce(vec![key_id("k")]))).is_err());
}

#[test]
fn link_that_stands_by_is_put_in_use_by_the_lower_id_at_the_request_of_the_higher() {
    let standby = LinkMessage::Elected(Elected { link: [9; 16], election: 4, standby: Some(true) });
    for peer_elects in [true, false] {
        let mut order = MessageOrder::new(Side::Server, false);
        order.accept(&messages()[0]).unwrap();
        order.hello_checked(peer_elects);
        assert!(order.accept(&LinkMessage::SwitchOver).is_err(), "before the election");
        assert_eq!(order.accept(&standby).is_ok(), peer_elects);
        order.stands_by();
        assert!(order.accept(&standby).is_err(), "it stands by already");
        assert!(order.accept(&LinkMessage::Graph(GraphUpdate::default())).is_err());
        assert!(order.accept(&LinkMessage::Keys(KeyMessage::Announce(vec![key_id("k")]))).is_err());
        order.accept(&LinkMessage::Keepalive).unwrap();
        assert_eq!(order.accept(&LinkMessage::SwitchOver).is_ok(), !peer_elects);
        assert_eq!(order.accept(&elected()).is_ok(), peer_elects);
        order.elected();
        assert!(order.accept(&elected()).is_err(), "a third ELECTED");
        assert_eq!(order.accept(&LinkMessage::SwitchOver).is_ok(), !peer_elects, "it crossed");
        order.accept(&LinkMessage::Graph(GraphUpdate::default())).unwrap();
    }
}
