//! What a client makes of a ServerHello, or of a HelloRetryRequest.

use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::{AlertDescription, ClientConnection, Error, PeerMisbehaved};

use crate::common::*;
use crate::peer::{
    digest, ext, list16, message, plaintext, records, server_hello, Early, HANDSHAKE,
};

/// What the last alert in a flight says.
fn alert_in(flight: &[u8]) -> Option<AlertDescription> {
    match flight {
        [.., 21, 3, 3, 0, 2, 2, alert] => Some(AlertDescription::from(*alert)),
        _ => None,
    }
}

/// The error of a client, and its alert, on a ServerHello made from the extensions given.
fn client_on_server_hello(
    mut client: ClientConnection,
    suite: u16,
    random: [u8; 32],
    extensions: &[(u16, &[u8])],
) -> (Error, Option<AlertDescription>) {
    let client_hello = plaintext(&written(&mut client));
    let list: Vec<_> = extensions.iter().map(|(kind, data)| ext(*kind, data)).collect();
    let record = records(HANDSHAKE, &server_hello(&client_hello, suite, random, &list));
    let error = feed(&mut client, &record).unwrap_err();
    let flight = written(&mut client);
    (error, alert_in(&flight))
}

const TLS13: (u16, &[u8]) = (43, &[3, 4]);
const FIRST_PSK: (u16, &[u8]) = (41, &[0, 0]);
const HELLO_RETRY_REQUEST: [u8; 32] = [
    0xcf, 0x21, 0xad, 0x74, 0xe5, 0x9a, 0x61, 0x11, 0xbe, 0x1d, 0x8c, 0x02, 0x1e, 0x65, 0xb8, 0x91,
    0xc2, 0xa2, 0x11, 0x16, 0x7a, 0xbb, 0x8c, 0x5e, 0x07, 0x9e, 0x09, 0xe2, 0xc8, 0xa8, 0x33, 0x9c,
];

#[test]
fn client_refuses_hostile_server_hellos() {
    use AlertDescription::{
        DecodeError, HandshakeFailure, IllegalParameter, ProtocolVersion, UnsupportedExtension,
    };

    let x25519_share: Vec<u8> = [&[0, 29, 0, 32][..], &[9; 32]].concat();
    let client = |mode| client(client_config(&[SHA256, SHA384], vec![psk("a", 1, SHA256)], mode));
    let [psk_ke, psk_dhe_ke] = MODES;

    for (mode, suite, extensions, alert) in [
        // no PSK selected, so a certificate would follow
        (psk_ke, 0x1303, &[TLS13][..], HandshakeFailure),
        (psk_dhe_ke, 0x1303, &[TLS13, (51, &x25519_share)], HandshakeFailure),
        // one that was not offered
        (psk_ke, 0x1303, &[TLS13, (41, &[0, 1])], IllegalParameter),
        (psk_ke, 0x1303, &[TLS13, (41, &[0xff, 0xff])], IllegalParameter),
        // a suite that was not offered, as its hash is not the PSK's
        (psk_ke, 0x1302, &[TLS13, FIRST_PSK], IllegalParameter),
        // and one that does not exist
        (psk_ke, 0x13fa, &[TLS13, FIRST_PSK], IllegalParameter),
        // a key share where there must be none
        (psk_ke, 0x1303, &[TLS13, FIRST_PSK, (51, &x25519_share)], UnsupportedExtension),
        // none, or of another group, where there must be one
        (psk_dhe_ke, 0x1303, &[TLS13, FIRST_PSK], IllegalParameter),
        (psk_dhe_ke, 0x1303, &[TLS13, FIRST_PSK, (51, &x25519_share)], IllegalParameter),
        // early data acknowledged where it cannot be
        (psk_ke, 0x1303, &[TLS13, FIRST_PSK, (42, &[])], UnsupportedExtension),
        // TLS 1.2
        (psk_ke, 0x1303, &[], ProtocolVersion),
        (psk_ke, 0xc02b, &[], ProtocolVersion),
        (psk_ke, 0x1303, &[(43, &[3, 3]), FIRST_PSK], ProtocolVersion),
        // an offer where the selection should be
        (psk_ke, 0x1303, &[TLS13, (41, &[0, 7, 0, 1, b'a', 0, 0, 0, 0])], DecodeError),
    ] {
        let (error, sent) = client_on_server_hello(client(mode), suite, [7; 32], extensions);
        assert_eq!(sent, Some(alert), "{mode:?} {suite:x} {extensions:?}: {error}");
    }

    // two hashes offered, and the PSK of one selected with the suite of the other
    let both = vec![psk("a", 1, SHA256), psk("b", 2, SHA384)];
    let client = self::client(client_config(&[SHA256, SHA384], both, psk_ke));
    let (error, sent) = client_on_server_hello(client, 0x1302, [7; 32], &[TLS13, FIRST_PSK]);
    assert_eq!(error, PeerMisbehaved::SelectedExternalPskWithIncompatibleCipherSuite.into());
    assert_eq!(sent, Some(IllegalParameter));
}

#[test]
fn client_refuses_another_session_id() {
    for change in [0, 31] {
        let psks = vec![psk("a", 1, SHA256)];
        let mut client = client(client_config(&[SHA256], psks, PskKeyExchangeMode::PskKe));
        let mut hello = plaintext(&written(&mut client));
        // what the server sees is not what was sent: handshake header 4, version 2, random 32,
        // length 1, and then the session ID that it echoes
        hello[39 + change] ^= 1;
        let extensions = [ext(43, &[3, 4]), ext(41, &[0, 0])];
        let hello = server_hello(&hello, 0x1303, [7; 32], &extensions);
        let refused = feed(&mut client, &records(HANDSHAKE, &hello)).unwrap_err();
        assert_eq!(refused, PeerMisbehaved::ServerHelloWithWrongSessionId.into());
        assert_eq!(written(&mut client).last(), Some(&47));
    }
}

/// A share that is good, for a group that is not the one it says.
#[test]
fn client_refuses_a_share_under_another_name() {
    let mode = PskKeyExchangeMode::PskDheKe;
    for (group, alert) in [(29_u16, None), (0xfe00, Some(47)), (23, Some(47)), (0x11ec, Some(47))] {
        let psks = vec![psk("a", 1, SHA256)];
        let mut client = client(client_config_over(&[SHA256], &[kx_group::X25519], psks, mode));
        let hello = plaintext(&written(&mut client));
        let share = kx_group::X25519.start().unwrap();
        let share = [&group.to_be_bytes()[..], &list16(share.pub_key())].concat();
        let extensions = [ext(43, &[3, 4]), ext(41, &[0, 0]), ext(51, &share)];
        let hello = server_hello(&hello, 0x1303, [7; 32], &extensions);
        let refused = feed(&mut client, &records(HANDSHAKE, &hello)).is_err();
        assert_eq!(refused.then(|| *written(&mut client).last().unwrap()), alert, "{group:x}");
    }
}

#[test]
fn client_refuses_hello_retry_request_without_cause() {
    let [psk_ke, psk_dhe_ke] = MODES;
    for (mode, extensions) in [
        (psk_ke, &[TLS13, (51, &[0x11, 0xec])][..]),
        (psk_ke, &[TLS13, (44, &[0, 1, 7])]),
        (psk_ke, &[TLS13]),
        (psk_dhe_ke, &[TLS13, (51, &[0x11, 0xec])]),
        (psk_dhe_ke, &[TLS13, (51, &[0, 29])]),
        (psk_dhe_ke, &[TLS13, (51, &[0x11, 0xec]), (44, &[0, 1, 7])]),
    ] {
        let client = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
        let (error, alert) =
            client_on_server_hello(client, 0x1303, HELLO_RETRY_REQUEST, extensions);
        assert_eq!(alert, Some(AlertDescription::IllegalParameter), "{mode:?}: {error}");
    }
}

/// A client in psk_dhe_ke that answered a HelloRetryRequest for the suite of `a`.
struct Retried {
    client: ClientConnection,
    first: Vec<u8>,
    retry: Vec<u8>,
    second: Vec<u8>,
}

impl Retried {
    fn new(extensions: &[(u16, &[u8])]) -> Self {
        let groups = [kx_group::X25519, kx_group::SECP256R1];
        let psks = vec![psk("a", 1, SHA256), psk("b", 2, SHA384)];
        let mode = PskKeyExchangeMode::PskDheKe;
        let mut client = client(client_config_over(&[SHA256, SHA384], &groups, psks, mode));
        let first = plaintext(&written(&mut client));
        let list: Vec<_> = extensions.iter().map(|(kind, data)| ext(*kind, data)).collect();
        let retry = server_hello(&first, 0x1303, HELLO_RETRY_REQUEST, &list);
        feed(&mut client, &records(HANDSHAKE, &retry)).unwrap();
        let second = plaintext(&written(&mut client));
        Self { client, first, retry, second }
    }
}

#[test]
fn client_refuses_an_invalid_server_hello_after_a_retry() {
    let retry = [TLS13, (51, &[0, 23])];
    let share = |group: u16, len| [&group.to_be_bytes()[..], &list16(&vec![4; len])].concat();
    let (none, first_group) = (share(23, 65), share(29, 32));
    // good ones, of which a client that does not look at the name would make the same keys
    let point = kx_group::SECP256R1.start().unwrap().pub_key().to_vec();
    let named = |group: u16| [&group.to_be_bytes()[..], &list16(&point)].concat();
    let (right, misnamed) = (named(23), named(29));

    for (what, suite, random, extensions, alert) in [
        ("the group of before", 0x1303, [7; 32], &[TLS13, FIRST_PSK, (51, &first_group)][..], 47),
        ("under the name of before", 0x1303, [7; 32], &[TLS13, FIRST_PSK, (51, &misnamed)], 47),
        ("another suite", 0x1302, [7; 32], &[TLS13, FIRST_PSK, (51, &right)], 47),
        ("a PSK that was dropped", 0x1303, [7; 32], &[TLS13, (41, &[0, 1]), (51, &right)], 47),
        ("no PSK", 0x1303, [7; 32], &[TLS13, (51, &right)], 40),
        ("no share", 0x1303, [7; 32], &[TLS13, FIRST_PSK], 47),
        ("not on the curve", 0x1303, [7; 32], &[TLS13, FIRST_PSK, (51, &none)], 47),
        ("to retry again", 0x1303, HELLO_RETRY_REQUEST, &[TLS13, (51, &[0, 29])], 10),
    ] {
        let Retried { mut client, second, .. } = Retried::new(&retry);
        let list: Vec<_> = extensions.iter().map(|(kind, data)| ext(*kind, data)).collect();
        let hello = server_hello(&second, suite, random, &list);
        let error = feed(&mut client, &records(HANDSHAKE, &hello)).unwrap_err();
        assert_eq!(written(&mut client).last(), Some(&alert), "{what}: {error}");
        assert!(client.external_psk().is_none());
    }
}

/// The offer of the second ClientHello: PSKs of the suite's hash, bound to all that was said.
#[test]
fn the_second_client_hello_is_bound_to_the_first() {
    for extensions in [&[TLS13, (44, &[0, 3, 1, 2, 3])][..], &[TLS13, (51, &[0, 23])]] {
        let Retried { first, retry, second, .. } = Retried::new(extensions);
        let tail = [&[0, 41, 0, 44, 0, 7, 0, 1, b'a'][..], &[0; 4], &[0, 33, 32]].concat();
        let end = second.len() - 32;
        assert_eq!(&second[end - tail.len()..end], tail);
        let bound = [message(254, &digest(&first)), retry, second[..end - 3].to_vec()].concat();
        let binder = Early::new(Some(&[1; 32])).binder("ext binder", &digest(&bound));
        assert_eq!(&second[end..], binder);
    }
}

/// RFC 8446 4.1.2 lists what may be another. The suites are not in that list.
#[test]
fn the_second_client_hello_changes_only_the_requested_extension() {
    for (extensions, asked) in
        [(&[TLS13, (44, &[0, 3, 1, 2, 3])][..], 44), (&[TLS13, (51, &[0, 23])], 51)]
    {
        let Retried { first, second, .. } = Retried::new(extensions);
        let (first_fields, first) = parts(&first);
        let (second_fields, second) = parts(&second);
        assert_eq!(first_fields, second_fields, "version, random, session ID, suites, compression");
        let unasked = |list: Vec<(u16, Vec<u8>)>| -> Vec<_> {
            list.into_iter().filter(|(kind, _)| ![41, asked].contains(kind)).collect()
        };
        let answer = second.iter().find(|(kind, _)| *kind == asked).map(|(_, data)| &data[..]);
        match asked {
            44 => assert_eq!(answer, Some(&[0, 3, 1, 2, 3][..])),
            // one share, of P-256
            _ => assert_eq!(answer.map(|data| &data[..6]), Some(&[0, 69, 0, 23, 0, 65][..])),
        }
        assert_eq!(unasked(first), unasked(second), "extensions, and their order");
    }
}

/// A ClientHello in front of its extensions, and those.
pub(crate) fn parts(hello: &[u8]) -> (Vec<u8>, Vec<(u16, Vec<u8>)>) {
    let number = |at: usize| u16::from_be_bytes([hello[at], hello[at + 1]]);
    // handshake header 4, version 2, random 32
    let suites = 38 + 1 + usize::from(hello[38]);
    let compression = suites + 2 + usize::from(number(suites));
    let start = compression + 1 + usize::from(hello[compression]);
    let mut list = Vec::new();
    let mut at = start + 2;
    while at < hello.len() {
        let end = at + 4 + usize::from(number(at + 2));
        list.push((number(at), hello[at + 4..end].to_vec()));
        at = end;
    }
    // without the header, which has the length
    (hello[4..start].to_vec(), list)
}

/// Nothing is cut short to make room for what a server wants to have echoed.
#[test]
fn client_refuses_a_cookie_it_cannot_carry() {
    let mode = PskKeyExchangeMode::PskDheKe;
    for len in [64_400, 65_000, 65_400] {
        let cookie = list16(&vec![7; len]);
        let client = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
        let extensions = [TLS13, (44, &cookie[..])];
        let (_, alert) = client_on_server_hello(client, 0x1303, HELLO_RETRY_REQUEST, &extensions);
        assert_eq!(alert, Some(AlertDescription::InternalError), "{len}");
    }

    let mut client = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
    let hello = plaintext(&written(&mut client));
    let extensions = [ext(43, &[3, 4]), ext(44, &list16(&[7; 60_000]))];
    let retry = server_hello(&hello, 0x1303, HELLO_RETRY_REQUEST, &extensions);
    feed(&mut client, &records(HANDSHAKE, &retry)).unwrap();
    assert!(written(&mut client).len() > 60_000, "what it can carry, it does");
}
