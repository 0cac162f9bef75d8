"""A small provider on this machine that does what it is sent: honest by default, and every kind of trouble on demand.

It checks what a client owes a provider by itself (PKCE, secret, redirect address, a code for one use), with nothing
of the code under test: a client that left one out would not get its tokens.
"""

import base64
import hashlib
import json
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, parse_qsl, unquote_plus, urlencode, urlsplit, urlunsplit

from joserfc.jwk import ECKey, RSAKey

from tests.support.oidc.tokens import AUDIENCE, CLIENT, KEY, published, signed

SECRET = "the client's secret, 100 % sure & +more"  # what a form and a Basic header both have to escape
Answer = tuple[int, dict[str, str], bytes]


@dataclass
class Provider:
    """What the provider believes, and how it misbehaves."""

    issuer: str = ""
    keys: list[RSAKey | ECKey] = field(default_factory=lambda: [KEY])
    person: dict[str, Any] = field(
        default_factory=lambda: {"sub": "u-1", "name": "Jane Doe", "groups": ["radiotherapy", "canteen"]}
    )
    machine: dict[str, Any] = field(default_factory=lambda: {"scope": "tidegate.read"})
    changes: dict[str, Any] = field(default_factory=dict)
    on_return: dict[str, str] = field(default_factory=dict)
    description: dict[str, Any] = field(default_factory=dict)
    forge: Callable[[str], str] = str
    trouble: dict[str, Callable[[], Answer]] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    codes: dict[str, dict[str, str]] = field(default_factory=dict)

    def answer(self, method: str, path: str, query: dict[str, str], form: dict[str, str], basic: str) -> Answer:
        self.asked.append(path)
        if path in self.trouble:
            return self.trouble[path]()
        if path == "/.well-known/openid-configuration":
            return _json({**self._description(), **self.description})
        if path == "/jwks":
            return _json(published(*self.keys))
        if path == "/authorize":
            return self._authorize(query)
        if path == "/token" and method == "POST":
            return self._token(form, basic)
        return 404, {}, b""

    def _description(self) -> dict[str, Any]:
        return {
            "issuer": self.issuer,
            "authorization_endpoint": f"{self.issuer}/authorize",
            "token_endpoint": f"{self.issuer}/token",
            "jwks_uri": f"{self.issuer}/jwks",
            "code_challenge_methods_supported": ["S256"],
            "authorization_response_iss_parameter_supported": True,
        }

    def _authorize(self, query: dict[str, str]) -> Answer:
        assert query["response_type"] == "code"
        assert query["code_challenge_method"] == "S256"
        assert "openid" in query["scope"].split()
        assert len(query["state"]) >= 40
        assert len(query["nonce"]) >= 40
        code = secrets.token_urlsafe(16)
        self.codes[code] = query
        reported = {"code": code, "state": query["state"], "iss": self.issuer, **self.on_return}
        reported = {name: value for name, value in reported.items() if value}
        return 302, {"Location": f"{query['redirect_uri']}?{urlencode(reported)}"}, b""

    def _token(self, form: dict[str, str], basic: str) -> Answer:
        ways = self.description.get("token_endpoint_auth_methods_supported", ["client_secret_basic"])
        posted = f"{form.get('client_id')}:{form.get('client_secret')}"
        if (basic if "client_secret_basic" in ways else posted) != f"{CLIENT}:{SECRET}":
            return _json({"error": "invalid_client"}, 401)
        if form["grant_type"] == "client_credentials":
            return self._machine_token()
        asked = self.codes.pop(form["code"], None)
        if asked is None or asked["redirect_uri"] != form["redirect_uri"] or not _proves(form, asked):
            return _json({"error": "invalid_grant"}, 400)
        now_s = int(time.time())
        claims = {"iss": self.issuer, "aud": CLIENT, "iat": now_s, "exp": now_s + 300, "nonce": asked["nonce"]}
        claims = {**claims, **self.person, **self.changes}
        claims = {name: value for name, value in claims.items() if value is not ...}
        token = self.forge(signed(claims, key=self.keys[0]))
        return _json({"access_token": "opaque", "token_type": "Bearer", "id_token": token, "expires_in": 300})

    def _machine_token(self) -> Answer:
        now_s = int(time.time())
        claims = {
            "iss": self.issuer,
            "aud": AUDIENCE,
            "iat": now_s,
            "exp": now_s + 300,
            "sub": "rvs",
            "client_id": "rvs",
        }
        token = signed({**claims, **self.machine, **self.changes}, key=self.keys[0], typ="at+jwt")
        return _json({"access_token": token, "token_type": "Bearer", "expires_in": 300})


def _proves(form: dict[str, str], asked: dict[str, str]) -> bool:
    digest = hashlib.sha256(form.get("code_verifier", "").encode()).digest()
    return asked["code_challenge"] == base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def _json(content: object, status: int = 200) -> Answer:
    return status, {"Content-Type": "application/json"}, json.dumps(content).encode()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._serve({})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self._serve(dict(parse_qsl(body, strict_parsing=True)))

    def _serve(self, form: dict[str, str]) -> None:
        parts = urlsplit(self.path)
        query = {name: values[0] for name, values in parse_qs(parts.query).items()}
        kind, _, coded = self.headers.get("Authorization", "").partition(" ")
        basic = base64.b64decode(coded).decode() if kind == "Basic" else ""
        basic = ":".join(unquote_plus(part) for part in basic.split(":", 1))
        provider = self.server.provider  # type: ignore[attr-defined]
        status, headers, body = provider.answer(self.command, parts.path, query, form, basic)
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        try:
            self.wfile.write(body)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the client has had enough, as it should

    def log_message(self, *_arguments: object) -> None:
        pass


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_arguments: object) -> None:
        pass


@contextmanager
def running(provider: Provider | None = None) -> Iterator[Provider]:
    """Serve on a free port of this machine."""
    provider = provider or Provider()
    server = _Server(("127.0.0.1", 0), _Handler)
    server.provider = provider  # type: ignore[attr-defined]
    provider.issuer = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield provider
    finally:
        server.shutdown()
        server.server_close()
        thread.join(5.0)


def without_query(address: str) -> str:
    return urlunsplit((*urlsplit(address)[:3], "", ""))
