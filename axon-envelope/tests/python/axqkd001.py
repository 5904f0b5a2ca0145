#!/usr/bin/env python3
"""AXQKD001 a second time, written from docs/axqkd001.md and sharing no code with the Rust crate.

    axqkd001.py vectors          print the test vectors (tests/vectors/axqkd001.json)
    axqkd001.py check < FILE     check vectors
    axqkd001.py seal < CASES     seal each case of a JSON array, print an array of envelopes
    axqkd001.py open < CASES     open each case of a JSON array, print plaintexts or refusals

Needs `cryptography` from PyPI. For tests: it keeps keys in ordinary memory.
"""

import hashlib
import json
import struct
import sys

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

MAGIC = b"AXQKD001"
TAG_LEN = 16
MESSAGES_PER_KEY = 10


class Malformed(Exception):
    """Not an AXQKD001 header; the reason may be told to anyone."""


class Refused(Exception):
    """A cryptographic failure; the reason is for the local log alone."""


def lp(data):
    return struct.pack(">H", len(data)) + data


def topic_hash(domain, topic, type_name):
    text = struct.pack(">I", domain) + lp(topic.encode()) + lp(type_name.encode())
    return hashlib.sha256(text).digest()[:16]


def aead_key(kme_key, key_id, sender, receiver, context):
    info = lp(b"seal") + lp(key_id) + lp(sender) + lp(receiver) + lp(context)
    return HKDF(SHA256(), 32, salt=MAGIC, info=info).derive(kme_key)


def make_header(kind, index, topic, sender, key_id, prefix):
    return (
        MAGIC
        + bytes([kind, 0, index])
        + topic
        + bytes([len(sender)])
        + sender
        + bytes([len(key_id)])
        + key_id
        + prefix
        + struct.pack(">I", index)
    )


def parse_header(data):
    """Returns (kind, index, topic, sender, key_id, nonce, header length)."""
    at = 0

    def take(count):
        nonlocal at
        if len(data) < at + count:
            raise Malformed("truncated")
        at += count
        return data[at - count : at]

    if take(8) != MAGIC:
        raise Malformed("magic")
    kind = take(1)[0]
    if kind > 2:
        raise Malformed("kind")
    if take(1) != b"\0":
        raise Malformed("flags")
    index = take(1)[0]
    topic = take(16)
    ids = []
    for name in ("empty_sender", "empty_key_id"):
        length = take(1)[0]
        if length == 0:
            raise Malformed(name)
        ids.append(take(length))
    nonce = take(12)
    if struct.unpack(">I", nonce[8:])[0] != index:
        raise Malformed("nonce_index")
    return kind, index, topic, ids[0], ids[1], nonce, at


class Link:
    """A channel and the keys known on it: seals as its sender, opens as its receiver."""

    def __init__(self, sender, receiver, context, kme_keys):
        self.sender = sender
        self.keys = {i: aead_key(k, i, sender, receiver, context) for i, k in kme_keys.items()}
        self.opened = {i: set() for i in self.keys}

    def seal(self, key_id, kind, topic, index, prefix, plaintext):
        header = make_header(kind, index, topic, self.sender, key_id, prefix)
        return header + AESGCM(self.keys[key_id]).encrypt(header[-12:], plaintext, header)

    def open(self, kind, topic, envelope):
        found_kind, index, found_topic, sender, key_id, nonce, at = parse_header(envelope)
        if len(envelope) < at + TAG_LEN:
            raise Malformed("truncated")
        if sender != self.sender:
            raise Refused("wrong_sender")
        if (found_kind, found_topic) != (kind, topic):
            raise Refused("wrong_route")
        if index >= MESSAGES_PER_KEY:
            raise Refused("index_out_of_range")
        if key_id not in self.keys:
            raise Refused("unknown_key")
        if index in self.opened[key_id]:
            raise Refused("replayed")
        try:
            plaintext = AESGCM(self.keys[key_id]).decrypt(nonce, envelope[at:], envelope[:at])
        except InvalidTag:
            raise Refused("unauthentic") from None
        self.opened[key_id].add(index)
        return plaintext


def link_of(case):
    return Link(
        case["sender"].encode(),
        case["receiver"].encode(),
        bytes.fromhex(case["context"]),
        {case["key_id"].encode(): bytes.fromhex(case["kme_key"])},
    )


def seal_case(case):
    return link_of(case).seal(
        case["key_id"].encode(),
        case["kind"],
        bytes.fromhex(case["topic_hash"]),
        case["index"],
        bytes.fromhex(case["nonce_prefix"]),
        bytes.fromhex(case["plaintext"]),
    )


def open_case(case):
    """What an opener does that has opened `case["opened_before"]` already."""
    link = link_of(case)
    route = case["kind"], bytes.fromhex(case["topic_hash"])
    for earlier in case.get("opened_before", []):
        link.open(*route, bytes.fromhex(earlier))
    try:
        return {"plaintext": link.open(*route, bytes.fromhex(case["envelope"])).hex()}
    except Malformed as error:
        return {"malformed": str(error)}
    except Refused as error:
        return {"refused": str(error)}


# --- vectors -------------------------------------------------------------------------------------

BASE = {
    "kme_key": bytes(range(32)).hex(),
    "key_id": "bc490419-7d60-487f-adc1-4ddcc177c139",
    "sender": "sae-robot-a",
    "receiver": "sae-robot-b",
    "context": bytes(range(0x80, 0xA0)).hex(),
    "domain": 42,
    "topic": "/scan",
    "type": "sensor_msgs/msg/LaserScan",
    "kind": 0,
    "index": 0,
    "nonce_prefix": "a0a1a2a3a4a5a6a7",
    "plaintext": b"hello, robot".hex(),
}


def with_hash(changes):
    case = {**BASE, **changes}
    case["topic_hash"] = topic_hash(case["domain"], case["topic"], case["type"]).hex()
    return case


def accepted(name, **changes):
    case = with_hash(changes)
    ids = case["key_id"].encode(), case["sender"].encode(), case["receiver"].encode()
    key = aead_key(bytes.fromhex(case["kme_key"]), *ids, bytes.fromhex(case["context"]))
    envelope = seal_case(case)
    header = envelope[: parse_header(envelope)[-1]]
    found = {"aead_key": key.hex(), "header": header.hex(), "envelope": envelope.hex()}
    return {"name": name, **case, **found}


def refused(name, expect, envelope, **changes):
    case = with_hash(changes)
    for unused in ("index", "nonce_prefix", "plaintext"):
        del case[unused]
    case = {"name": name, **case, "envelope": envelope.hex(), **expect}
    got = open_case(case)
    assert got == expect, (name, got)
    return case


def vectors():
    accept = [
        accepted("first message of a key"),
        accepted("last message of a key", index=9),
        accepted("request", kind=1, index=1, topic="/add", type="example_interfaces/srv/AddTwoInts"),
        accepted("response", kind=2, index=2, topic="/add", type="example_interfaces/srv/AddTwoInts"),
        accepted("empty plaintext", index=3, plaintext=""),
        accepted("one block", index=4, plaintext=bytes(16).hex()),
        accepted("a thousand bytes", index=5, plaintext=(bytes(range(250)) * 4).hex()),
        accepted("shortest IDs, empty context", sender="a", receiver="b", key_id="k", context=""),
        accepted("longest IDs", sender="s" * 255, receiver="r" * 255, key_id="k" * 255),
        accepted("names beyond ASCII", sender="roboter-ä", topic="/größe", domain=0xFFFFFFFF),
        accepted("other direction, same KME key", sender="sae-robot-b", receiver="sae-robot-a"),
    ]
    good = bytes.fromhex(accept[0]["envelope"])
    head = len(bytes.fromhex(accept[0]["header"]))
    sender_at, key_id_at = 27, 27 + 1 + len(BASE["sender"])

    def put(at, data):
        return good[:at] + data + good[at + len(data) :]

    def flip(at):
        return put(at, bytes([good[at] ^ 1]))

    def sealed(**changes):
        return seal_case(with_hash(changes))

    def malformed(name, reason, envelope):
        return refused(name, {"malformed": reason}, envelope)

    def no(name, reason, envelope, **changes):
        return refused(name, {"refused": reason}, envelope, **changes)

    bare_key = AESGCM(bytes.fromhex(BASE["kme_key"]))
    underived = good[:head] + bare_key.encrypt(good[head - 12 : head], b"x", good[:head])
    refuse = [
        malformed("no bytes", "truncated", b""),
        malformed("magic alone", "truncated", good[:8]),
        malformed("cut before the nonce's end", "truncated", good[: head - 1]),
        malformed("cut within the tag", "truncated", good[: head + 15]),
        malformed("next version's magic", "magic", put(7, b"2")),
        malformed("kind 3", "kind", put(8, b"\x03")),
        malformed("a flag", "flags", put(9, b"\x01")),
        malformed("empty sender", "empty_sender", put(sender_at, b"\0")),
        malformed("empty key_ID", "empty_key_id", put(key_id_at, b"\0")),
        malformed("sender longer than the message", "truncated", put(sender_at, b"\xff")),
        malformed("index changed, nonce not", "nonce_index", put(10, b"\x01")),
        malformed("nonce counter changed", "nonce_index", flip(head - 1)),
        malformed("nonce counter beyond a byte", "nonce_index", put(head - 4, b"\0\0\x01\0")),
        no("eleventh message", "index_out_of_range", sealed(index=10)),
        no("index 255", "index_out_of_range", sealed(index=255)),
        no("unknown key_ID", "unknown_key", sealed(key_id="11111111-7d60-487f-adc1-4ddcc177c139")),
        no("key_ID in upper case", "unknown_key", sealed(key_id=BASE["key_id"].upper())),
        no("another sender", "wrong_sender", sealed(sender="sae-robot-c")),
        no("reflected", "wrong_sender", sealed(sender="sae-robot-b", receiver="sae-robot-a")),
        no("another receiver", "unauthentic", sealed(receiver="sae-robot-c")),
        no("another context", "unauthentic", sealed(context="00" * 32)),
        no("empty context", "unauthentic", sealed(context="")),
        no("another KME key", "unauthentic", sealed(kme_key="00" * 32)),
        no("request where a topic is expected", "wrong_route", sealed(kind=1)),
        no("another topic", "wrong_route", sealed(topic="/odom")),
        no("another domain", "wrong_route", sealed(domain=43)),
        no("topic hash changed to the expected one", "unauthentic", put(11, topic_hash(42, "/odom", "t")), topic="/odom", type="t"),
        no("kind changed to the expected one", "unauthentic", put(8, b"\x02"), kind=2),
        no("nonce prefix changed", "unauthentic", flip(head - 12)),
        no("ciphertext changed", "unauthentic", flip(head)),
        no("tag's first bit changed", "unauthentic", flip(len(good) - 16)),
        no("tag's last bit changed", "unauthentic", flip(len(good) - 1)),
        no("last byte cut", "unauthentic", good[:-1]),
        no("a byte appended", "unauthentic", good + b"\0"),
        no("ciphertext cut out", "unauthentic", good[:head] + good[-16:]),
        no("sealed with the KME key itself", "unauthentic", underived),
    ]
    replay = dict(refuse[-1], name="replayed", envelope=good.hex(), opened_before=[good.hex()])
    replay["refused"] = "replayed"
    refuse.append(replay)
    reused = sealed(plaintext=b"another plaintext".hex())
    refuse.append(dict(replay, name="index used for a second message", envelope=reused.hex()))
    for case in refuse[-2:]:
        assert open_case(case) == {"refused": "replayed"}

    return {
        "format": "AXQKD001",
        "about": "accept: opens to plaintext. refuse: 'malformed' before any key is looked at, "
        "'refused' alike towards the sender, its cause for the local log alone; 'opened_before' "
        "opens first. Bytes in hexadecimal, IDs and names in UTF-8.",
        "accept": accept,
        "refuse": refuse,
    }


def check(data):
    for case in data["accept"]:
        assert topic_hash(case["domain"], case["topic"], case["type"]).hex() == case["topic_hash"]
        assert seal_case(case).hex() == case["envelope"], case["name"]
        assert open_case(case) == {"plaintext": case["plaintext"]}, case["name"]
    for case in data["refuse"]:
        expect = {k: case[k] for k in ("malformed", "refused") if k in case}
        assert open_case(case) == expect, case["name"]
    return f"{len(data['accept'])} accepted and {len(data['refuse'])} refused as they should be"


def main():
    command = sys.argv[1] if len(sys.argv) == 2 else ""
    if command == "vectors":
        print(json.dumps(vectors(), indent=1, ensure_ascii=False))
    elif command == "check":
        print(check(json.load(sys.stdin)))
    elif command == "seal":
        json.dump([seal_case(case).hex() for case in json.load(sys.stdin)], sys.stdout)
    elif command == "open":
        json.dump([open_case(case) for case in json.load(sys.stdin)], sys.stdout)
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
