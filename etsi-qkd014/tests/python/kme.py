"""Two KMEs in Python's standard library, written from the text of ETSI GS QKD 014 V1.1.1.

Shares nothing with the Rust code, so that a misreading there does not go unnoticed here. Clause
numbers in comments are of that document. For tests: the keys come from os.urandom.

usage: kme.py [--bend ANSWER.MEMBER=JSON]... [--old-tls] [--anyone] DIR STORED KME=ADDRESS=SAE[,SAE...]...

--bend makes an answer wrong: ANSWER is status, enc_keys, dec_keys or error, MEMBER a path as
keys.0.key_ID; without =JSON the member is left out. --old-tls accepts TLS of any version, --anyone
asks for no client certificate and serves everybody as the KME's first SAE. DIR holds ca.pem and, for each KME, ID.crt and ID.key. STORED is the number of keys to give in all.
Prints a line "KME PORT" for each KME once it listens. Ends when standard input ends.
"""

import argparse
import base64
import http.server
import json
import os
import pathlib
import ssl
import sys
import threading
import urllib.parse
import uuid

# The status example of clause 6.1, but for multicast.
KEY_SIZE, MIN_SIZE, MAX_SIZE = 352, 64, 1024
MAX_STORED, MAX_PER_REQUEST, MAX_SAE_IDS = 100_000, 128, 2


class Refused(Exception):
    """An error answer. The tables of clause 5 give 401 no data model, so it has no body."""

    def __init__(self, code, message=None, details=None):
        self.code = code
        self.body = {"message": message} if message else None
        if details:
            self.body["details"] = details


class Keys:
    """What a QKD network has put into all KMEs."""

    def __init__(self, stored, home):
        self.lock = threading.Lock()
        self.stored = stored
        self.home = home  # SAE ID: KME ID
        self.given = {}  # key_ID: (key, master, slaves that may have it, slaves that had it)

    def first(self, kme):
        return next(sae for sae, home in self.home.items() if home == kme)

    def draw(self, number, size, master, slaves):
        with self.lock:
            if number > self.stored:
                raise Refused(503, "key data access error")
            self.stored -= number
            keys = []
            for _ in range(number):
                name, key = str(uuid.uuid4()), os.urandom(size // 8)
                self.given[name] = (key, master, slaves, set())
                keys.append((name, key))
            return keys

    def fetch(self, names, master, slave):
        with self.lock:
            found = [self.given.get(name) for name in names]
            # Clause 5.4: 401 where the caller was not named for any of these keys.
            for entry in filter(None, found):
                if entry[1] != master or slave not in entry[2]:
                    raise Refused(401)
            if any(entry is None or slave in entry[3] for entry in found):
                # Clause 6.4.
                raise Refused(400, "one or more keys specified are not found on KME")
            for entry in found:
                entry[3].add(slave)
            return [(name, entry[0]) for name, entry in zip(names, found)]


def whole(value, what, low, high):
    """An integer within limits; a JSON true is none."""
    if type(value) is not int:
        raise Refused(400, f"{what} shall be an integer")
    if not low <= value <= high:
        raise Refused(400, f"{what} shall be from {low} to {high}")
    return value


def members(value, allowed, what):
    if not isinstance(value, dict) or not set(value) <= set(allowed):
        raise Refused(400, f"{what} is not as specified")
    return value


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 30

    def setup(self):
        # In the connection's own thread, so that one slow client holds up nobody.
        self.request.settimeout(self.timeout)
        self.request.do_handshake()
        super().setup()
        shown = self.request.getpeercert() or {"subject": ()}
        subject = dict(pair for part in shown["subject"] for pair in part)
        self.caller = subject.get("commonName", self.server.anyone)

    def do_GET(self):
        self.answer(self.get)

    def do_POST(self):
        self.answer(self.post)

    def answer(self, method):
        try:
            length = int(self.headers.get("Content-Length", "0"))
            self.body = self.rfile.read(length)
            code, body = 200, method()
        except Refused as refused:
            code, body = refused.code, refused.body
        self.bend("error" if code != 200 else urllib.parse.urlsplit(self.path).path.split("/")[5], body)
        raw = b"" if body is None else json.dumps(body, indent=4).encode()
        self.send_response(code)
        if raw:
            self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(raw)))
        self.end_headers()
        self.wfile.write(raw)

    def bend(self, answer, body):
        """Makes the body wrong in the ways that were asked for."""
        for wanted, path, value in self.server.bends:
            if wanted == answer:
                *way, last = [int(part) if part.isdigit() else part for part in path]
                at = body
                try:
                    for part in way:
                        at = at[part]
                    if value is None:
                        del at[last]
                    else:
                        at[last] = json.loads(value)
                except (IndexError, KeyError, TypeError):
                    pass  # An answer without this member.

    def resource(self):
        """The SAE ID and the method name in the URL (clause 5.1, table 2), and the query."""
        url = urllib.parse.urlsplit(self.path)
        parts = url.path.split("/")
        if len(parts) != 6 or parts[:4] != ["", "api", "v1", "keys"]:
            raise Refused(400, "no such resource")
        if self.server.keys.home.get(self.caller) != self.server.kme:
            raise Refused(401)
        try:
            query = urllib.parse.parse_qs(url.query, strict_parsing=True) if url.query else {}
        except ValueError:
            raise Refused(400, "the query cannot be read") from None
        if any(len(values) != 1 for values in query.values()):
            raise Refused(400, "a parameter is given twice")
        query = {name: values[0] for name, values in query.items()}
        return urllib.parse.unquote(parts[4]), parts[5], query

    def get(self):
        sae, name, query = self.resource()
        if name == "status":
            return self.status(sae)
        if name == "enc_keys":
            try:
                query = {key: int(value) for key, value in query.items()}
            except ValueError:
                raise Refused(400, "number and size shall be integers") from None
            return self.enc_keys(sae, members(query, ["number", "size"], "the query"))
        if name == "dec_keys" and list(query) == ["key_ID"]:
            return self.container(self.server.keys.fetch([query["key_ID"]], sae, self.caller))
        raise Refused(400, "no such resource or no such parameter")

    def post(self):
        sae, name, _ = self.resource()
        # Clause 5.1, table 1.
        if self.headers.get_content_type() != "application/json":
            raise Refused(400, "the content type shall be application/json")
        try:
            asked = json.loads(self.body.decode("utf-8"))
        except ValueError:
            raise Refused(400, "the body is not JSON") from None
        if name == "enc_keys":
            return self.enc_keys(sae, asked)
        if name == "dec_keys":
            asked = members(asked, ["key_IDs", "key_IDs_extension"], "key IDs")
            listed = asked.get("key_IDs")
            if not isinstance(listed, list) or not 1 <= len(listed) <= MAX_PER_REQUEST:
                raise Refused(400, f"key_IDs shall be an array of 1 to {MAX_PER_REQUEST}")
            names = [members(i, ["key_ID", "key_ID_extension"], "key_IDs").get("key_ID") for i in listed]
            if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
                raise Refused(400, "each key_ID shall be a string of its own")
            return self.container(self.server.keys.fetch(names, sae, self.caller))
        raise Refused(400, "no such resource")

    def status(self, slave):
        # Clause 6.1.
        home = self.server.keys.home
        if slave not in home:
            raise Refused(400, "the slave SAE is not known")
        return {
            "source_KME_ID": self.server.kme,
            "target_KME_ID": home[slave],
            "master_SAE_ID": self.caller,
            "slave_SAE_ID": slave,
            "key_size": KEY_SIZE,
            "stored_key_count": self.server.keys.stored,
            "max_key_count": MAX_STORED,
            "max_key_per_request": MAX_PER_REQUEST,
            "max_key_size": MAX_SIZE,
            "min_key_size": MIN_SIZE,
            "max_SAE_ID_count": MAX_SAE_IDS,
            "status_extension": {"py_server": "http.server"},
        }

    def enc_keys(self, slave, asked):
        # Clause 6.2.
        allowed = ["number", "size", "additional_slave_SAE_IDs"]
        allowed += ["extension_mandatory", "extension_optional"]
        asked = members(asked, allowed, "the key request")
        number = whole(asked.get("number", 1), "number", 1, MAX_PER_REQUEST)
        size = whole(asked.get("size", KEY_SIZE), "size", MIN_SIZE, MAX_SIZE)
        if size % 8:
            raise Refused(400, "size shall be a multiple of 8")
        more = asked.get("additional_slave_SAE_IDs", [])
        if not isinstance(more, list) or len(more) > MAX_SAE_IDS:
            raise Refused(400, f"additional_slave_SAE_IDs shall be an array of up to {MAX_SAE_IDS}")
        for sae in [slave, *more]:
            if sae not in self.server.keys.home:
                raise Refused(400, "a slave SAE is not known")
        for extension in ["extension_mandatory", "extension_optional"]:
            listed = asked.get(extension, [])
            if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
                raise Refused(400, f"{extension} shall be an array of objects")
        wanted = [name for item in asked.get("extension_mandatory", []) for name in item]
        details = [
            {"extension_mandatory_unsupported": f"{name} is not supported"}
            for name in wanted
            if name != "py_route_type"
        ]
        if details:
            raise Refused(400, "not all extension_mandatory parameters are supported", details)
        keys = self.server.keys.draw(number, size, self.caller, {slave, *more})
        body = self.container(keys)
        if wanted:
            body["key_container_extension"] = {"py_route_type": "direct"}
            for key in body["keys"]:
                key["key_extension"] = {"py_hops": 1}
                key["key_ID_extension"] = {"py_link": self.server.kme}
        return body

    def container(self, keys):
        # Clause 6.3.
        encode = lambda key: base64.b64encode(key).decode()
        return {"keys": [{"key_ID": name, "key": encode(key)} for name, key in keys]}

    def log_message(self, *_):
        pass


class Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, kme, address, directory, keys, wrong):
        super().__init__((address, 0), Handler)
        self.kme, self.keys, self.bends = kme, keys, wrong.bend
        self.anyone = keys.first(kme) if wrong.anyone else None
        # Clause 5.1: TLS 1.2 or higher, and both sides show a certificate.
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.minimum_version = ssl.TLSVersion.TLSv1_2
        tls.load_cert_chain(directory / f"{kme}.crt", directory / f"{kme}.key")
        tls.load_verify_locations(directory / "ca.pem")
        tls.verify_mode = ssl.CERT_NONE if wrong.anyone else ssl.CERT_REQUIRED
        if wrong.old_tls:
            tls.minimum_version = ssl.TLSVersion.MINIMUM_SUPPORTED
            tls.set_ciphers("ALL:@SECLEVEL=0")
        self.socket = tls.wrap_socket(self.socket, server_side=True, do_handshake_on_connect=False)

    def handle_error(self, request, client_address):
        # A client that breaks off or is refused in the handshake is its own business.
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def bent(text):
    """Of ANSWER.MEMBER=JSON the three parts."""
    path, _, value = text.partition("=")
    answer, *path = path.split(".")
    return answer, path, value or None


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--bend", action="append", default=[], type=bent)
    arguments.add_argument("--old-tls", action="store_true")
    arguments.add_argument("--anyone", action="store_true")
    arguments.add_argument("directory", type=pathlib.Path)
    arguments.add_argument("stored", type=int)
    arguments.add_argument("sites", nargs="+")
    arguments = arguments.parse_args()
    sites = [site.split("=") for site in arguments.sites]
    home = {sae: kme for kme, _, saes in sites for sae in saes.split(",")}
    keys = Keys(arguments.stored, home)
    for kme, address, _ in sites:
        server = Server(kme, address, arguments.directory, keys, arguments)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(kme, server.server_address[1], flush=True)
    sys.stdin.read()


main()
