"""Calls to the provider end: in time, within bounds, and as one of two errors."""

import contextlib
import gzip
import socket
import threading
import time

import pytest

from service.access.oidc import http_client
from service.access.oidc.http_client import ProviderClient
from service.access.oidc.refusals import OidcReason, OidcRefusedError, OidcUnavailableError
from tests.support.oidc.provider_server import SECRET, Provider, running
from tests.support.oidc.tokens import CLIENT

pytestmark = pytest.mark.slow

WIRE = ProviderClient(client_id=CLIENT, client_secret=SECRET, timeout_s=0.5)
PATIENT = ProviderClient(client_id=CLIENT, client_secret=SECRET, timeout_s=30.0)


@pytest.fixture
def provider():
    with running() as one:
        yield one


def unavailable(provider: Provider, wire: ProviderClient = WIRE) -> str:
    with pytest.raises(OidcUnavailableError) as caught:
        wire.get_json(f"{provider.issuer}/jwks")
    return str(caught.value)


def test_keys_are_read(provider):
    assert WIRE.get_json(f"{provider.issuer}/jwks")["keys"][0]["kid"] == "first"


def test_a_missing_server_is_reported_as_such():
    with running() as gone:
        pass
    assert "cannot be reached" in unavailable(gone)


def test_an_answer_that_never_comes_is_given_up(provider):
    is_over = threading.Event()
    provider.trouble["/jwks"] = lambda: (is_over.wait(20.0), (200, {}, b"{}"))[1]
    before_s = time.monotonic()
    assert "ReadTimeout" in unavailable(provider)
    assert time.monotonic() - before_s < 5.0
    is_over.set()


def test_an_answer_of_100_megabytes_is_read_as_far_as_the_bound(provider):
    answer = b" " * 100_000_000
    provider.trouble["/jwks"] = lambda: (200, {}, answer)
    assert "more than 524288 bytes" in unavailable(provider, PATIENT)


@contextlib.contextmanager
def trickling(beginning: bytes):
    """A server whose answer comes one byte at a time after this beginning, each well within the longest silence."""
    is_over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with contextlib.suppress(OSError), listener.accept()[0] as connection:
                connection.sendall(beginning)
                while not is_over.wait(0.05):
                    connection.sendall(b"a")

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield Provider(issuer=f"http://127.0.0.1:{listener.getsockname()[1]}")
        is_over.set()
        thread.join(5.0)


def test_an_answer_whose_head_trickles_is_given_up_and_its_call_ends_by_itself(monkeypatch):
    spare = threading.BoundedSemaphore(1)
    monkeypatch.setattr(http_client, "_CALL_SLOTS", spare)
    with trickling(b"HTTP/1.1 200 OK\r\nX-A: ") as provider:
        before_s = time.monotonic()
        assert "did not begin in time" in unavailable(provider)
        assert time.monotonic() - before_s < 5.0
        assert spare.acquire(timeout=5.0)  # what was left behind is over
        assert "too many calls" in unavailable(provider)


def test_an_answer_whose_body_trickles_ends_by_the_clock():
    with trickling(b"HTTP/1.1 200 OK\r\n\r\n") as provider:
        assert "did not end in time" in unavailable(provider)


def test_a_compressed_answer_is_not_unpacked(provider):
    provider.trouble["/jwks"] = lambda: (200, {"Content-Encoding": "gzip"}, gzip.compress(b"{}"))
    assert "compressed" in unavailable(provider)


def test_no_redirect_is_followed(provider):
    provider.trouble["/jwks"] = lambda: (302, {"Location": f"{provider.issuer}/elsewhere"}, b"")
    assert "answered 302" in unavailable(provider)
    assert "/elsewhere" not in provider.asked


@pytest.mark.parametrize(
    "body", [b"", b"[]", b"<html>", b"\xff", b"[" * 100_000, b"7"], ids=lambda body: repr(body[:8])
)
def test_what_is_no_json_object_is_reported_as_that(provider, body):
    provider.trouble["/jwks"] = lambda: (200, {"Content-Type": "application/json"}, body)
    assert "no JSON" in unavailable(provider)


def exchange(provider: Provider, code: str = "unknown") -> object:
    return WIRE.exchange(f"{provider.issuer}/token", code=code, verifier="v" * 43, redirect_uri="http://localhost/r")


def test_a_code_that_the_provider_does_not_take_is_refused(provider):
    with pytest.raises(OidcRefusedError) as caught:
        exchange(provider)
    assert caught.value.reason is OidcReason.CODE


@pytest.mark.parametrize(
    "answer",
    [(500, b"{}"), (200, b"<html>"), (429, b"slow down"), (200, b"[1]"), (302, b""), (200, b"[" * 100_000)],
    ids=lambda answer: str(answer)[:20],
)
def test_an_exchange_that_no_provider_would_answer_so_is_reported_as_unavailable(provider, answer):
    status, body = answer
    provider.trouble["/token"] = lambda: (status, {"Content-Type": "application/json"}, body)
    with pytest.raises(OidcUnavailableError):
        exchange(provider)


def test_an_exchange_of_100_megabytes_is_read_as_far_as_the_bound(provider):
    provider.trouble["/token"] = lambda: (200, {"Content-Type": "application/json"}, b" " * 100_000_000)
    with pytest.raises(OidcUnavailableError, match="more than"):
        exchange(provider)


def test_no_proxy_of_the_environment_sees_a_code(provider, monkeypatch):
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    assert WIRE.get_json(f"{provider.issuer}/jwks")
    with pytest.raises(OidcRefusedError):
        exchange(provider)
