"""A server that does what a test tells it, on a real socket: answers, cuts connections, drips, says nothing."""

import threading
from collections.abc import Iterator

import pytest

from service.client import TidegateClient
from tests.support.client.scripted_server import KEY, Handler, House, _Server


@pytest.fixture
def house() -> Iterator[House]:
    house = House()
    with _Server(("127.0.0.1", 0), Handler) as server:
        server.house, house.port = house, server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield house
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def waits() -> list[float]:
    """How long the client meant to wait."""
    return []


@pytest.fixture
def client(house: House, waits: list[float]) -> Iterator[TidegateClient]:
    with TidegateClient(
        f"http://127.0.0.1:{house.port}", key=KEY, operator="A. Therapist", timeout_s=2.0, sleep=waits.append
    ) as client:
        yield client
