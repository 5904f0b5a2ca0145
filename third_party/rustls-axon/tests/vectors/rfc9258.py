#!/usr/bin/env python3
"""Vectors of RFC 9258, from the standard library alone. Prints rfc9258.json."""

import hashlib
import hmac
import json

KDFS = {"sha256": 1, "sha384": 2}


def u16(number):
    return number.to_bytes(2, "big")


def extract(name, salt, secret):
    return hmac.new(salt, secret, name).digest()


def expand_label(name, secret, label, context, length):
    label = b"tls13 " + label
    info = u16(length) + bytes([len(label)]) + label + bytes([len(context)]) + context
    out, block, counter = b"", b"", 1
    while len(out) < length:
        block = hmac.new(secret, block + info + bytes([counter]), name).digest()
        out, counter = out + block, counter + 1
    return out[:length]


def imported(external_identity, context, base_key, base_hash, target_hash):
    identity = (
        u16(len(external_identity)) + external_identity + u16(len(context)) + context
        + u16(0x0304) + u16(KDFS[target_hash])
    )
    size = hashlib.new(base_hash).digest_size
    epskx = extract(base_hash, bytes(size), base_key)
    length = hashlib.new(target_hash).digest_size
    digest = hashlib.new(base_hash, identity).digest()
    ipskx = expand_label(base_hash, epskx, b"derived psk", digest, length)
    return {
        "external_identity": external_identity.hex(),
        "context": context.hex(),
        "base_key": base_key.hex(),
        "base_hash": base_hash,
        "target_hash": target_hash,
        "imported_identity": identity.hex(),
        "ipskx": ipskx.hex(),
    }


VECTORS = [
    imported(name, context, key, base, target)
    for name, context, key in [
        (b"the key of today", b"", bytes(range(32))),
        (b"k", b"\x00\x05alice\x00\x03bob", bytes(range(48))),
        (bytes(range(256)) * 3, bytes(range(200)), b"\xff" * 16),
    ]
    for base in KDFS
    for target in KDFS
]

# RFC 8448, section 4: the resumption secret, the hash of the truncated ClientHello, the binder.
# That the same functions give this one is what makes the others worth comparing with.
RFC8448_PSK = bytes.fromhex("4ecd0eb6ec3b4d87f5d6028f922ca4c5851a277fd41311c9e62d2c9492e1c4f3")
RFC8448_HASH = bytes.fromhex("63224b2e4573f2d3454ca84b9d009a04f6be9e05711a8396473aefa01e924a14")
RFC8448_BINDER = "3add4fb2d8fdf822a0ca3cf7678ef5e88dae990141c5924d57bb6fa31b9e5f9d"


def rfc8448_binder():
    early = extract("sha256", bytes(32), RFC8448_PSK)
    empty = hashlib.sha256().digest()
    key = expand_label("sha256", early, b"res binder", empty, 32)
    finished = expand_label("sha256", key, b"finished", b"", 32)
    return hmac.new(finished, RFC8448_HASH, "sha256").hexdigest()


if __name__ == "__main__":
    assert rfc8448_binder() == RFC8448_BINDER
    print(json.dumps(VECTORS, indent=2))
