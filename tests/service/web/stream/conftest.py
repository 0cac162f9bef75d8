"""One service for the tests that need nothing special of it; each begins its own session."""

from collections.abc import Iterator

import pytest

from tests.support.stream.stream_server import Served, served


@pytest.fixture(scope="package")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("stream")) as one:
        yield one


@pytest.fixture
def session_id(service: Served) -> Iterator[str]:
    session_id = service.begin_session()
    yield session_id
    service.end_session(session_id)
