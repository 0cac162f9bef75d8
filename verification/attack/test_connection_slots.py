"""Which connection is replaced: one that waits for its client; half a body counts as waiting."""

import asyncio
import contextlib
import threading
import time

import pytest
from fastapi import FastAPI, Request
from starlette.requests import ClientDisconnect
from starlette.responses import StreamingResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from service.access.request.identity import STATE
from service.core.settings.groups import ConnectionLimits
from service.web.server import make_server
from tests.support.service.processes import free_port
from tests.support.waiting import eventually
from verification.attack.raw_connections import connection, read_all

EACH, ALL = 16, 64
"""Places of an address, and of all: as few as there may be."""
AT_ONCE_S = 1.0
"""Far below the time that a body is waited for."""
PIECES, PIECE = 500, b"x" * 65_536


class KnowsWhoSaysSo:
    """Marks callers with a header as known, as the guard does, and counts the requests that passed."""

    def __init__(self, app: ASGIApp, served: "Served") -> None:
        self._app = app
        self._served = served

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if (b"x-known", b"yes") in scope.get("headers", ()):
            scope[STATE] = "somebody"
        if scope["type"] == "http":
            self._served.received += 1
        await self._app(scope, receive, send)


class Served:
    """A server of few places, and what comes to its calls."""

    def __init__(self) -> None:
        self.app = FastAPI()
        self.app.add_middleware(KnowsWhoSaysSo, served=self)
        self.app.state.hold_and_close_session = lambda: None
        self.release = threading.Event()
        self.working = 0
        self.received = 0
        self.app.post("/hold")(self._take)
        self.app.post("/login")(self._take)
        self.app.post("/work")(self._work)
        self.app.get("/file")(self._give)
        self.port = free_port()
        connection_limits = ConnectionLimits(max_connections=ALL, max_connections_per_address=EACH)
        self.server = make_server(self.app, host="127.0.0.1", port=self.port, connection_limits=connection_limits)

    async def _take(self, request: Request) -> int:
        with contextlib.suppress(ClientDisconnect):
            return len(await request.body())
        return 0

    async def _give(self) -> StreamingResponse:
        return StreamingResponse(iter([PIECE] * PIECES))

    async def _work(self, request: Request) -> str:
        await request.body()
        self.working += 1
        await asyncio.to_thread(self.release.wait, 20.0)
        return "done"


def until(is_so) -> None:
    eventually(is_so, within_s=20.0, pause_s=0.001)


@pytest.fixture
def served():
    it = Served()
    thread = threading.Thread(target=lambda: asyncio.run(it.server.serve()))
    thread.start()
    until(lambda: it.server.started)
    yield it
    it.release.set()
    it.server.should_exit = True
    thread.join(20.0)


def head(path: str, length: int, *more: str, method: str = "POST") -> bytes:
    lines = [f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", "Connection: close", f"Content-Length: {length}", *more]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def crowd(stack, served, source: str, first: bytes, count: int = EACH):
    """As many as may come from an address, who one behind the other say the same and then nothing."""
    raws = []
    for _ in range(count):
        raw, received = stack.enter_context(connection(served.port, source)), served.received
        raw.sendall(first)
        if first:
            until(lambda before=received: served.received > before)
        raws.append(raw)
    return raws


def assert_held_at_once(served, source: str) -> None:
    begin_s = time.monotonic()
    with connection(served.port, source) as raw:
        raw.sendall(head("/hold", 2) + b"{}")
        reply = read_all(raw)
    assert reply.status == 200, reply
    assert time.monotonic() - begin_s < AT_ONCE_S


@pytest.mark.parametrize("known", [(), ("X-Known: yes",)], ids=["strangers", "callers whom the guard knows"])
def test_half_bodies_keep_no_hold_out_from_their_address_nor_from_another(served, known):
    half = head("/login", 100, *known) + b'{"name": '
    with contextlib.ExitStack() as stack:
        crowd(stack, served, "127.0.0.2", half)
        assert_held_at_once(served, "127.0.0.2")
        for i in range(2, 2 + ALL // EACH):
            crowd(stack, served, f"127.0.0.{i}", half)
        for source in ("127.0.0.2", "127.0.0.99"):
            assert_held_at_once(served, source)


def test_a_hold_whose_body_follows_its_head_gets_in_on_an_old_connection_too(served):
    half = head("/login", 100) + b"{"
    with contextlib.ExitStack() as stack:
        (old,) = crowd(stack, served, "127.0.0.2", b"", 1)
        crowd(stack, served, "127.0.0.2", half, EACH - 1)
        received = served.received
        old.sendall(head("/hold", 2))
        until(lambda: served.received > received)
        crowd(stack, served, "127.0.0.2", half, EACH // 2)
        old.sendall(b"{}")
        assert read_all(old).status == 200


def test_an_upload_of_a_known_caller_outlasts_any_number_of_unknown_callers(served):
    with contextlib.ExitStack() as stack:
        (upload,) = crowd(stack, served, "127.0.0.2", head("/hold", 50, "X-Known: yes"), 1)
        for _ in range(5):
            upload.sendall(b"x" * 10)
            crowd(stack, served, "127.0.0.2", head("/login", 100) + b"{")
            crowd(stack, served, "127.0.0.3", head("/login", 100) + b"{")
        reply = read_all(upload)
    assert reply.status == 200
    assert reply.content.endswith(b"50")


def test_a_request_in_progress_is_not_closed_for_another(served):
    with contextlib.ExitStack() as stack:
        busy = crowd(stack, served, "127.0.0.2", head("/work", 2) + b"{}")
        until(lambda: served.working == EACH)
        for _ in range(3):
            with connection(served.port, "127.0.0.2") as raw:
                assert read_all(raw).status == 503
        served.release.set()
        assert [read_all(raw).status for raw in busy] == [200] * EACH


def test_who_reads_nothing_keeps_no_hold_out(served):
    with contextlib.ExitStack() as stack:
        crowd(stack, served, "127.0.0.2", head("/file", 0, method="GET"))
        until(lambda: sum(one.waits for one in served.server.server_state.connections) == EACH)
        assert_held_at_once(served, "127.0.0.2")
