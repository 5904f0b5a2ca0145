"""An SAE pair in Python's standard library, written from the text of ETSI GS QKD 014 V1.1.1.

Walks a master and a slave through the whole interface of two KMEs and checks each answer against
the document; clause numbers are of it. Shares nothing with the Rust code.

usage: sae.py SETTINGS

SETTINGS is a JSON file: {"master": SAE, "slave": SAE, "third": SAE}, each SAE an object with id, url,
kme, ca, cert and key (file names). The third SAE is a second slave. Prints the number of checks made;
the exit status is 1 at the first that fails.
"""

import base64
import json
import ssl
import sys
import urllib.error
import urllib.parse
import urllib.request
import uuid

CHECKS = 0


def check(true, what):
    global CHECKS
    CHECKS += 1
    if not true:
        sys.exit(f"check {CHECKS} failed: {what}")


class Sae:
    def __init__(self, id, url, kme, ca, cert, key):
        self.id, self.url, self.kme = id, url, kme
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        tls.load_verify_locations(ca)
        tls.load_cert_chain(cert, key)
        self.tls = tls

    def call(self, sae, method, body=None, query=None, media="application/json"):
        """Status code and JSON of one call; a body makes it a POST."""
        url = f"{self.url}/api/v1/keys/{urllib.parse.quote(sae, safe='')}/{method}"
        if query:
            url += "?" + urllib.parse.urlencode(query)
        data = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        request = urllib.request.Request(url, data=data)
        if data is not None:
            request.add_header("Content-Type", media)
        try:
            with urllib.request.urlopen(request, context=self.tls, timeout=20) as answer:
                check(answer.headers.get_content_type() == "application/json", "5.1: content type")
                return answer.status, json.loads(answer.read().decode("utf-8"))
        except urllib.error.HTTPError as error:
            raw = error.read()
            return error.code, json.loads(raw) if raw else None


def refused(answer, code, message=None):
    check(answer[0] == code, f"expected {code}, got {answer[0]}: {answer[1]}")
    if code != 401:
        # Clause 6.5.
        check(isinstance(answer[1].get("message"), str), "6.5: message")
        details = answer[1].get("details", [])
        check(isinstance(details, list) and all(isinstance(d, dict) for d in details), "6.5: details")
    if message is not None:
        check(answer[1]["message"] == message, f"expected {message!r}, got {answer[1]['message']!r}")


def keys_of(answer, number, bits):
    """Clause 6.3: key_ID to key."""
    check(answer[0] == 200, f"keys expected, got {answer}")
    keys = {}
    check(len(answer[1]["keys"]) == number, "6.3: the number of keys asked for")
    for entry in answer[1]["keys"]:
        check(str(uuid.UUID(entry["key_ID"])) == entry["key_ID"].lower(), "6.3: key_ID is a UUID")
        key = base64.b64decode(entry["key"], validate=True)
        check(len(key) * 8 == bits, "6.3: the size asked for")
        keys[entry["key_ID"]] = key
    check(len(keys) == number == len(set(keys.values())), "each key and key_ID once")
    return keys


def main():
    settings = json.load(open(sys.argv[1], encoding="utf-8"))
    master, slave, third = (Sae(**settings[role]) for role in ["master", "slave", "third"])

    code, status = master.call(slave.id, "status")
    check(code == 200, "5.2")
    named = [status[n] for n in ["source_KME_ID", "target_KME_ID", "master_SAE_ID", "slave_SAE_ID"]]
    check(named == [master.kme, slave.kme, master.id, slave.id], f"6.1: {named}")
    counts = ["key_size", "stored_key_count", "max_key_count", "max_key_per_request"]
    for name in [*counts, "max_key_size", "min_key_size", "max_SAE_ID_count"]:
        check(type(status[name]) is int, f"6.1: {name} is an integer")
    check(status["min_key_size"] <= status["key_size"] <= status["max_key_size"], "6.1: sizes")
    size, most = status["key_size"], status["max_key_per_request"]

    # Clause 6.2: all items are optional; an empty request may be a GET.
    for answer in [master.call(slave.id, "enc_keys"), master.call(slave.id, "enc_keys", {})]:
        keys = keys_of(answer, 1, size)
        (name,) = keys
        same = slave.call(master.id, "dec_keys", query={"key_ID": name})
        check(keys_of(same, 1, size) == keys, "5.4: the same key")
        message = "one or more keys specified are not found on KME"
        refused(slave.call(master.id, "dec_keys", query={"key_ID": name}), 400, message)
    keys = keys_of(master.call(slave.id, "enc_keys", query={"number": 3, "size": 1024}), 3, 1024)
    asked = {"key_IDs": [{"key_ID": name} for name in keys]}
    refused(master.call(slave.id, "dec_keys", asked), 401)
    refused(third.call(master.id, "dec_keys", asked), 401)
    check(keys_of(slave.call(master.id, "dec_keys", asked), 3, 1024) == keys, "5.4: the same keys")

    keys = keys_of(master.call(slave.id, "enc_keys", {"number": most, "size": 512}), most, 512)
    asked = {"key_IDs": [{"key_ID": name, "key_ID_extension": {}} for name in keys]}
    asked["key_IDs_extension"] = {"py_any": 1}
    check(keys_of(slave.call(master.id, "dec_keys", asked), most, 512) == keys, "6.4: extensions")

    # Annex B.
    keys = keys_of(master.call(slave.id, "enc_keys", {"additional_slave_SAE_IDs": [third.id]}), 1, size)
    asked = {"key_IDs": [{"key_ID": name} for name in keys]}
    for sae in [third, slave]:
        check(keys_of(sae.call(master.id, "dec_keys", asked), 1, size) == keys, "B: the same key")

    # Clause 6.2: what a KME shall refuse, and in which words.
    enc = lambda body: master.call(slave.id, "enc_keys", body)
    refused(enc({"size": 1001}), 400, "size shall be a multiple of 8")
    refused(master.call(slave.id, "enc_keys", query={"size": 1001}), 400, "size shall be a multiple of 8")
    answer = enc({"extension_mandatory": [{"abc_route_type": "direct"}]})
    refused(answer, 400, "not all extension_mandatory parameters are supported")
    # Clause 6.5, second example.
    unsupported = {"extension_mandatory_unsupported": "abc_route_type is not supported"}
    check(answer[1]["details"] == [unsupported], f"6.5: {answer[1]}")
    keys_of(enc({"extension_optional": [{"abc_max_age": 30000}]}), 1, size)
    wrong = [{"number": 0}, {"number": -1}, {"number": most + 1}, {"number": "1"}, {"number": 1.5}]
    wrong += [{"number": None}, {"size": None}, {"number": True}, [], 1, b"null", {"size": 0}]
    wrong += [{"size": status["max_key_size"] + 8}, {"extension_mandatory": {}}]
    wrong += [{"additional_slave_SAE_IDs": "x"}, {"extension_optional": [1]}, b"{", b"\xff"]
    for body in wrong:
        refused(enc(body), 400)
    refused(master.call(slave.id, "enc_keys", {}, media="text/plain"), 400)
    for body in [{}, {"key_IDs": []}, {"key_IDs": [{}]}, {"key_IDs": [{"key_ID": 1}]}, b"{"]:
        refused(slave.call(master.id, "dec_keys", body), 400)
    refused(master.call("nobody", "status"), 400)
    print(CHECKS)


main()
