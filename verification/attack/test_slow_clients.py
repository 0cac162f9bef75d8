"""Clients that wait: with half a request, with half a body, with nothing to ask, with what they asked for unread."""

import concurrent.futures
import contextlib
import select
import time

import pytest

from verification.attack.limits import PATIENCE_S
from verification.attack.raw_connections import Reply, ask, connection, read_all

LOOK_S = 1.0
"""How often the service looks."""
LATEST_S = PATIENCE_S + LOOK_S + 3.0
LONG_S = 20.0
SCRIPT = b"GET /js/main.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
GET = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n"
USUAL_S = 1.0
"""A call to hold is answered within this, on a machine whose cores are all busy with other tests."""


def drip(raw, first: bytes, drop: bytes) -> Reply:
    """Send a drop every tenth of a second, until hung up on."""
    raw.sendall(first)
    begin_s = time.monotonic()
    with contextlib.suppress(ConnectionError):
        while time.monotonic() < begin_s + 2 * LATEST_S:
            reply = read_all(raw, 0.1)
            if reply.content or reply.is_closed:
                rest = read_all(raw, LATEST_S)  # what an idle connection is closed after, on a busy machine
                is_closed = reply.is_closed or rest.is_closed
                waited_s = time.monotonic() - begin_s
                return Reply(content=reply.content + rest.content, is_closed=is_closed, seconds=waited_s)
            raw.sendall(drop)
    return Reply(content=b"", is_closed=True, seconds=time.monotonic() - begin_s)


def _is_ended(raw) -> bool:
    try:
        return raw.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def _post(attacked) -> bytes:
    key = "".join(f"{name}: {value}\r\n" for name, value in attacked.key.items())
    path = f"/api/v1/sessions/{attacked.session_id}/arm"
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{key}Content-Type: application/json\r\nContent-Length: 500\r\n"
    return head.encode() + b"\r\n{"


def test_a_slow_sender_is_answered_and_disconnected(attacked):
    ways = {
        "nothing at all": (b"", b""),
        "headers, letter by letter": (GET, b"X"),
        "a body, letter by letter": (_post(attacked), b" "),
        "nothing after an answer": (GET + b"\r\n", b""),
        "a second request, letter by letter": (GET + b"\r\n" + GET, b"X"),
    }
    with concurrent.futures.ThreadPoolExecutor(len(ways)) as pool, contextlib.ExitStack() as stack:
        found = {
            name: pool.submit(drip, stack.enter_context(connection(attacked.port)), first, drop)
            for name, (first, drop) in ways.items()
        }
        replies = {name: one.result() for name, one in found.items()}
    assert all(reply.is_closed for reply in replies.values()), replies
    assert all(reply.seconds < LATEST_S + USUAL_S for reply in replies.values()), replies
    assert replies["nothing at all"].statuses == [408]
    assert replies["headers, letter by letter"].statuses == [408]
    assert replies["a body, letter by letter"].statuses == [408]
    assert replies["a body, letter by letter"].problem["code"] == "request_timeout"
    assert replies["nothing after an answer"].statuses == [200]


def test_who_reads_nothing_of_what_was_asked_for_is_cut_off(attacked):
    with connection(attacked.port, room=4096) as raw:
        raw.sendall(SCRIPT * 1_200)
        waiting = select.poll()
        waiting.register(raw, 0)  # for being cut off alone: what comes is left where it is
        assert waiting.poll(1000 * LONG_S), "still waited for"
        with pytest.raises(ConnectionError):
            raw.sendall(SCRIPT)


def test_who_asks_far_ahead_of_the_answers_is_cut_off(attacked):
    with connection(attacked.port, room=4096) as raw, pytest.raises(ConnectionError):
        raw.sendall(SCRIPT * 100_000)


def test_among_a_thousand_idle_connections_a_hold_gets_in_at_once_wherever_it_comes_from(attacked):
    with contextlib.ExitStack() as stack:
        for _ in range(1000):
            stack.enter_context(connection(attacked.port, "127.0.0.9"))
        for source in ("127.0.0.2", "127.0.0.9"):
            begin_s = time.monotonic()
            with connection(attacked.port, source) as raw:
                key = "".join(f"{name}: {value}\r\n" for name, value in attacked.key.items())
                path = f"/api/v1/sessions/{attacked.session_id}/hold"
                body = b'{"operator": "A. Therapist"}'
                head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n{key}"
                kind = f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
                raw.sendall((head + kind).encode() + body)
                reply = read_all(raw)
            assert reply.status in {200, 409}, reply  # 409: the fake engine's session is not armed
            assert time.monotonic() - begin_s < USUAL_S


def test_connections_of_one_address_are_bounded_and_the_newest_are_kept(attacked):
    with contextlib.ExitStack() as stack:
        raws = [stack.enter_context(connection(attacked.port, "127.0.0.8")) for _ in range(140)]
        assert ask(attacked.port, GET + b"\r\n").status == 200
        for raw in raws:
            raw.setblocking(False)
        ended = [_is_ended(raw) for raw in raws]
    assert ended[:12] == [True] * 12
    assert not any(ended[12:])
