#!/usr/bin/env python3
"""Makes psk.json: pre-shared keys of TLS derived from QKD keys.

Written against the text of docs/formats.md and RFC 5869, with nothing of the Rust code: what agrees
with this file agrees with the text. Run it in this directory; the output is the same every time.
"""

import hashlib
import hmac
import json
import urllib.parse

SALT = b"AXON-QKD-TLS13-EXTERNAL-PSK-v1"


def lp(text):
    data = text.encode()
    return len(data).to_bytes(2, "big") + data


def quoted(name):
    return urllib.parse.quote(name, safe="")


def hkdf_sha256(salt, ikm, info, length):
    prk = hmac.new(salt, ikm, hashlib.sha256).digest()
    okm, block, counter = b"", b"", 1
    while len(okm) < length:
        block = hmac.new(prk, block + info + bytes([counter]), hashlib.sha256).digest()
        okm += block
        counter += 1
    return okm[:length]


def vector(key, key_id, client, server, hash_name):
    length = {"SHA256": 32, "SHA384": 48}[hash_name]
    info = lp(key_id) + lp(client) + lp(server) + lp(hash_name)
    return {
        "key": key.hex(),
        "key_id": key_id,
        "client_sae": client,
        "server_sae": server,
        "hash": hash_name,
        "identity": ":".join(["axon-qkd-v1", quoted(client), quoted(key_id)]),
        "psk": hkdf_sha256(SALT, key, info, length).hex(),
    }


def main():
    uuid = "bc490419-7d60-487f-adc1-4ddcc177c139"
    counting = bytes(range(32))
    cases = [
        (bytes(32), "k", "a", "b"),
        (counting, uuid, "sae-client", "sae-server"),
        (counting, uuid, "sae-server", "sae-client"),
        (counting, uuid.upper(), "sae-client", "sae-server"),
        (bytes([255] * 32), uuid, "SAE:1/2 %", "r\u00f6bot-7"),
        (counting, "a/b=:=", "sae-client", "sae-server"),
    ]
    vectors = [vector(*case, name) for case in cases for name in ("SHA256", "SHA384")]
    with open("psk.json", "w", encoding="utf-8") as out:
        json.dump(vectors, out, indent=1)
        out.write("\n")


if __name__ == "__main__":
    main()
