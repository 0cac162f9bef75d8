"""A server that follows a test's script, on a real socket: answers, cuts connections, sends slowly or nothing."""

import threading
from collections.abc import Iterator

import pytest

from service.client import TidegateClient
from tests.support.client.scripted_server import KEY, Handler, Script, _Server


@pytest.fixture
def script() -> Iterator[Script]:
    script = Script()
    with _Server(("127.0.0.1", 0), Handler) as server:
        server.script, script.port = script, server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield script
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def waits() -> list[float]:
    """How long the client meant to wait."""
    return []


@pytest.fixture
def client(script: Script, waits: list[float]) -> Iterator[TidegateClient]:
    with TidegateClient(
        f"http://127.0.0.1:{script.port}", key=KEY, operator="A. Therapist", timeout_s=2.0, sleep=waits.append
    ) as client:
        yield client
