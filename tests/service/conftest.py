"""A service on a fake engine, with a calibration and a recording to make sessions from."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from engine.core.clock import NS_PER_S
from service.core.settings.settings import Settings
from service.sessions.lifecycle import commands, runner, start
from service.web.app import create_app
from tests.support.database.migrated import with_tables
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.fake_engine import FakeEngine, FakeRunning


@pytest.fixture(autouse=True)
def quick_answers() -> Iterator[None]:
    """Shorten the wait for the engine's answer, and for a batch of rows."""
    with pytest.MonkeyPatch.context() as patch:  # a test's own patches end before its service does
        patch.setattr(runner, "COMMAND_S", 0.2)
        patch.setattr(start, "SAMPLE_BATCH_S", 0.02)
        yield


@pytest.fixture
def settings(tmp_path: Path, database_url: str | None) -> Settings:
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    (recordings / "chest.oni").write_bytes(b"not read by the fake engine")
    return Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(recordings,),
        allowed_hosts=("testserver",),
        database_url=database_url,
    )


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine()


@pytest.fixture
def client(
    settings: Settings, engine: FakeEngine, migrated_file: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[PeopleClient]:
    monkeypatch.setattr(commands, "MAX_WAIT_NS", 60 * NS_PER_S)  # a slow machine makes no call too old
    with PeopleClient(create_app(with_tables(settings, migrated_file), lambda _settings: engine)) as client:
        yield client


@pytest.fixture
def calibration_text() -> str:
    return make_calibration().to_json()


@pytest.fixture
def calibration_id(client: PeopleClient, calibration_text: str) -> str:
    return upload(client, calibration_text).json()["id"]


@pytest.fixture
def session_body(calibration_id: str) -> dict[str, Any]:
    return make_session_body(calibration_id)


@pytest.fixture
def session_id(client: PeopleClient, session_body: dict[str, Any]) -> str:
    return client.post("/api/v1/sessions", json=session_body).json()["id"]


@pytest.fixture
def running(client: PeopleClient, session_id: str, engine: FakeEngine) -> FakeRunning:
    assert act(client, session_id, "start").status_code == 200
    return engine.running
