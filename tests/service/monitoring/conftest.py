"""A service on a fake engine, one for a module: these tests look at it and leave it as it is."""

from collections.abc import Iterator

import pytest

from service.core.settings.settings import Settings
from service.monitoring import readiness
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.fake_engine import FakeEngine


@pytest.fixture(autouse=True)
def always_new() -> Iterator[None]:
    """Disable the cache of readiness."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(readiness, "KEPT_MS", 0.0)
        yield


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return Settings(data_dir=tmp_path_factory.mktemp("data"), allowed_hosts=("testserver",))


@pytest.fixture(scope="module")
def client(settings: Settings) -> Iterator[PeopleClient]:
    with PeopleClient(create_app(settings, lambda _settings: FakeEngine()), raise_server_exceptions=False) as client:
        yield client
