//! Checks the sample packets of RFC 9001, appendix A, with the keys that this module gives quinn.
//! A.4, the Retry packet, is in `protection.rs`.

use super::tls::crypto::aws_lc_rs::cipher_suite::TLS13_CHACHA20_POLY1305_SHA256;
use super::tls::crypto::cipher::{AeadKey, Iv};
use super::*;

const DST_CID: &str = "8394c8f03e515708";

/// Checks a sample in both directions: protection must give the packet, and unprotection must give
/// the clear header and the payload.
fn both_ways(sender: &Keys, receiver: &Keys, sample: &Sample) {
    let (header, mut payload) = (hex(sample.header), hex(sample.payload));
    payload.resize(sample.payload_len, 0);
    let pn_offset = header.len() - sample.pn_len;

    let mut packet = [&header[..], &payload, &[0; 16]].concat();
    sender.packet.local.encrypt(sample.number, &mut packet, header.len());
    sender.header.local.encrypt(pn_offset, &mut packet);
    assert_eq!(packet, hex(sample.packet));

    receiver.header.remote.decrypt(pn_offset, &mut packet);
    assert_eq!(packet[..header.len()], header);
    let mut opened = BytesMut::from(&packet[header.len()..]);
    receiver.packet.remote.decrypt(sample.number, &header, &mut opened).unwrap();
    assert_eq!(opened, payload);

    for at in 0..packet.len() {
        let mut changed = packet.clone();
        changed[at] ^= 1;
        let (header, body) = changed.split_at(header.len());
        let mut body = BytesMut::from(body);
        assert!(receiver.packet.remote.decrypt(sample.number, header, &mut body).is_err());
    }
    let mut body = BytesMut::from(&packet[header.len()..]);
    let another = sample.number + 1;
    assert!(receiver.packet.remote.decrypt(another, &header, &mut body).is_err());
}

struct Sample {
    number: u64,
    pn_len: usize,
    header: &'static str,
    /// The payload without its padding.
    payload: &'static str,
    payload_len: usize,
    packet: &'static str,
}

/// A.1 and A.2: a client's Initial packet, with keys from its connection ID.
#[test]
fn client_initial() {
    let (client, server) = ends();
    both_ways(&client, &server, &CLIENT_INITIAL);
}

/// A.3: a server's Initial packet, with its own keys from the same connection ID.
#[test]
fn server_initial() {
    let (client, server) = ends();
    both_ways(&server, &client, &SERVER_INITIAL);
}

/// The limits on the number of packets (RFC 9001 section 6.6) identify AES-128-GCM.
#[test]
fn initial_keys_are_those_of_aes_128_gcm() {
    let (client, _) = ends();
    assert_eq!(client.header.local.sample_size(), 16);
    assert_eq!(client.packet.local.tag_len(), 16);
    assert_eq!(client.packet.local.confidentiality_limit(), 1 << 23);
    assert_eq!(client.packet.remote.integrity_limit(), 1 << 52);
}

#[test]
fn only_version_1_is_spoken() {
    for version in [0, 2, 0xff00_001d, 0x6b33_43cf, 0x709a_50c4] {
        assert!(supported(version).is_err(), "{version:#x}");
    }
    assert!(supported(1).is_ok());
}

/// A.5: a packet with a short header and ChaCha20-Poly1305, with the key, IV and header key that
/// the appendix derives.
#[test]
fn chacha20_short_header() {
    let suite = TLS13_CHACHA20_POLY1305_SHA256.tls13().unwrap().quic_suite().unwrap();
    let key = |hexadecimal| AeadKey::from(<[u8; 32]>::try_from(hex(hexadecimal)).unwrap());
    let iv = || Iv::from(<[u8; 12]>::try_from(hex("e0459b3474bdd0e44a41c144")).unwrap());
    let packet = || -> Box<dyn crypto::PacketKey> {
        let key = key("c6d98ff3441c3fe1b2182094f69caa2ed4b716b65488960a7a984979fb23e1c8");
        Box::new(PacketProtection(suite.quic.packet_key(key, iv())))
    };
    let header = || -> Box<dyn crypto::HeaderKey> {
        let key = key("25a282b9e82f06f21f488917a4fc8f1b73573685608597d0efcb076b0ab7a7a4");
        Box::new(HeaderProtection(suite.quic.header_protection_key(key)))
    };
    let keys = Keys {
        header: KeyPair { local: header(), remote: header() },
        packet: KeyPair { local: packet(), remote: packet() },
    };
    both_ways(&keys, &keys, &CHACHA20_SHORT);
    assert_eq!(keys.packet.remote.integrity_limit(), 1 << 36);
}

fn ends() -> (Keys, Keys) {
    let dst_cid = ConnectionId::new(&hex(DST_CID));
    let [client, server] =
        [Side::Client, Side::Server].map(|side| initial_keys(VERSION, &dst_cid, side));
    (client, server)
}

fn hex(digits: &str) -> Vec<u8> {
    let digits = digits.as_bytes().chunks(2).map(|pair| std::str::from_utf8(pair).unwrap());
    digits.map(|pair| u8::from_str_radix(pair, 16).unwrap()).collect()
}

const CLIENT_INITIAL: Sample = Sample {
    number: 2,
    pn_len: 4,
    header: "c300000001088394c8f03e5157080000449e00000002",
    payload: "\
        060040f1010000ed0303ebf8fa56f12939b9584a3896472ec40bb863cfd3e86804fe3a47f06a2b69484c0000\
        0413011302010000c000000010000e00000b6578616d706c652e636f6dff01000100000a00080006001d0017\
        001800100007000504616c706e000500050100000000003300260024001d00209370b2c9caa47fbabaf4559f\
        edba753de171fa71f50f1ce15d43e994ec74d748002b0003020304000d0010000e0403050306030203080408\
        050806002d00020101001c00024001003900320408ffffffffffffffff05048000ffff07048000ffff080110\
        0104800075300901100f088394c8f03e51570806048000ffff",
    payload_len: 1_162,
    packet: "\
        c000000001088394c8f03e5157080000449e7b9aec34d1b1c98dd7689fb8ec11d242b123dc9bd8bab936b47d\
        92ec356c0bab7df5976d27cd449f63300099f3991c260ec4c60d17b31f8429157bb35a1282a643a8d2262cad\
        67500cadb8e7378c8eb7539ec4d4905fed1bee1fc8aafba17c750e2c7ace01e6005f80fcb7df621230c83711\
        b39343fa028cea7f7fb5ff89eac2308249a02252155e2347b63d58c5457afd84d05dfffdb20392844ae81215\
        4682e9cf012f9021a6f0be17ddd0c2084dce25ff9b06cde535d0f920a2db1bf362c23e596d11a4f5a6cf3948\
        838a3aec4e15daf8500a6ef69ec4e3feb6b1d98e610ac8b7ec3faf6ad760b7bad1db4ba3485e8a94dc250ae3\
        fdb41ed15fb6a8e5eba0fc3dd60bc8e30c5c4287e53805db059ae0648db2f64264ed5e39be2e20d82df566da\
        8dd5998ccabdae053060ae6c7b4378e846d29f37ed7b4ea9ec5d82e7961b7f25a9323851f681d582363aa5f8\
        9937f5a67258bf63ad6f1a0b1d96dbd4faddfcefc5266ba6611722395c906556be52afe3f565636ad1b17d50\
        8b73d8743eeb524be22b3dcbc2c7468d54119c7468449a13d8e3b95811a198f3491de3e7fe942b330407abf8\
        2a4ed7c1b311663ac69890f4157015853d91e923037c227a33cdd5ec281ca3f79c44546b9d90ca00f064c99e\
        3dd97911d39fe9c5d0b23a229a234cb36186c4819e8b9c5927726632291d6a418211cc2962e20fe47feb3edf\
        330f2c603a9d48c0fcb5699dbfe5896425c5bac4aee82e57a85aaf4e2513e4f05796b07ba2ee47d80506f8d2\
        c25e50fd14de71e6c418559302f939b0e1abd576f279c4b2e0feb85c1f28ff18f58891ffef132eef2fa09346\
        aee33c28eb130ff28f5b766953334113211996d20011a198e3fc433f9f2541010ae17c1bf202580f6047472f\
        b36857fe843b19f5984009ddc324044e847a4f4a0ab34f719595de37252d6235365e9b84392b061085349d73\
        203a4a13e96f5432ec0fd4a1ee65accdd5e3904df54c1da510b0ff20dcc0c77fcb2c0e0eb605cb0504db8763\
        2cf3d8b4dae6e705769d1de354270123cb11450efc60ac47683d7b8d0f811365565fd98c4c8eb936bcab8d06\
        9fc33bd801b03adea2e1fbc5aa463d08ca19896d2bf59a071b851e6c239052172f296bfb5e72404790a21810\
        14f3b94a4e97d117b438130368cc39dbb2d198065ae3986547926cd2162f40a29f0c3c8745c0f50fba3852e5\
        66d44575c29d39a03f0cda721984b6f440591f355e12d439ff150aab7613499dbd49adabc8676eef023b15b6\
        5bfc5ca06948109f23f350db82123535eb8a7433bdabcb909271a6ecbcb58b936a88cd4e8f2e6ff5800175f1\
        13253d8fa9ca8885c2f552e657dc603f252e1a8e308f76f0be79e2fb8f5d5fbbe2e30ecadd220723c8c0aea8\
        078cdfcb3868263ff8f0940054da48781893a7e49ad5aff4af300cd804a6b6279ab3ff3afb64491c85194aab\
        760d58a606654f9f4400e8b38591356fbf6425aca26dc85244259ff2b19c41b9f96f3ca9ec1dde434da7d2d3\
        92b905ddf3d1f9af93d1af5950bd493f5aa731b4056df31bd267b6b90a079831aaf579be0a39013137aac6d4\
        04f518cfd46840647e78bfe706ca4cf5e9c5453e9f7cfd2b8b4c8d169a44e55c88d4a9a7f9474241e221af44\
        860018ab0856972e194cd934",
};

const SERVER_INITIAL: Sample = Sample {
    number: 1,
    pn_len: 2,
    header: "c1000000010008f067a5502a4262b50040750001",
    payload: "\
        02000000000600405a020000560303eefce7f7b37ba1d1632e96677825ddf73988cfc79825df566dc5430b9a\
        045a1200130100002e00330024001d00209d3c940d89690b84d08a60993c144eca684d1081287c834d5311bc\
        f32bb9da1a002b00020304",
    payload_len: 99,
    packet: "\
        cf000000010008f067a5502a4262b5004075c0d95a482cd0991cd25b0aac406a5816b6394100f37a1c697975\
        54780bb38cc5a99f5ede4cf73c3ec2493a1839b3dbcba3f6ea46c5b7684df3548e7ddeb9c3bf9c73cc3f3bde\
        d74b562bfb19fb84022f8ef4cdd93795d77d06edbb7aaf2f58891850abbdca3d20398c276456cbc42158407d\
        d074ee",
};

const CHACHA20_SHORT: Sample = Sample {
    number: 654_360_564,
    pn_len: 3,
    header: "4200bff4",
    payload: "01",
    payload_len: 1,
    packet: "4cfe4189655e5cd55c41f69080575d7999c25a5bfb",
};
