"""What is opened is closed: in its order at the end, and whole where a start is refused half-way."""

import contextlib
import threading

import pytest
from sqlalchemy import text

from engine.core.errors import TidegateError
from service.qa.rig import EngineRig
from service.sessions.recovery.journal import JournalInUseError
from service.storage.database.engine import Database
from service.storage.database.migrations import MigrationError
from service.storage.files.journals import Journals
from service.web.app import create_app
from service.web.container import open_container
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.fake_engine import FakeEngine


class WatchedEngine(FakeEngine):
    """Keeps what it found when it was closed: each of its engines ended or not."""

    def __init__(self):
        super().__init__()
        self.found_at_close = []

    def close(self):
        self.found_at_close.append([running.status.is_over for running in self.opened])


@pytest.fixture
def engine():
    return WatchedEngine()


def container_threads():
    named = {"access-cleanup", "armed-operator", "tidegate-cleanup", "tidegate-anchors", "tidegate-clock"}
    return [thread.name for thread in threading.enumerate() if thread.name in named]


def test_the_session_is_closed_before_its_engine_and_the_stop_is_the_last_row(settings, engine):
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        assert "access-cleanup" in container_threads()
    assert engine.found_at_close == [[True]]
    database = Database(settings.database_place)
    with database.read() as db:
        rows = list(db.scalars(text("SELECT action FROM audit ORDER BY sequence DESC LIMIT 2")))
    database.close()
    assert rows == ["service.stop", "session.close"]
    assert not container_threads()


def test_a_start_that_is_refused_before_its_database_leaves_no_engine(settings, engine):
    settings.data_dir.mkdir(mode=0o700)
    database = Database(settings.database_place)
    database.migrate()
    with database.write() as db:
        db.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    with pytest.raises(MigrationError):
        open_container(settings, engine, EngineRig(settings), None)
    assert engine.found_at_close == [[]]


def test_a_start_that_is_refused_half_way_leaves_no_engine_and_no_thread(settings, engine):
    def refuse(_name, _password):
        msg = "the first password could not be printed"
        raise TidegateError(msg)

    with pytest.raises(TidegateError, match="could not be printed"):
        open_container(settings, engine, EngineRig(settings), refuse)
    assert engine.found_at_close == [[]]
    assert not container_threads()


def test_a_start_that_is_refused_by_a_journal_in_use_leaves_no_engine_and_no_thread(settings, engine, monkeypatch):
    monkeypatch.setattr("service.storage.files.journals.PATIENCE_S", 0.0)
    settings.data_dir.mkdir(mode=0o700)
    with contextlib.closing(Journals(settings.data_dir, None).begin("left")), pytest.raises(JournalInUseError):
        open_container(settings, engine, EngineRig(settings), None)
    assert engine.found_at_close == [[]]
    assert not container_threads()
