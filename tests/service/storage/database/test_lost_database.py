"""The disk fills, or the database's file goes, while a session is written: the gate learns of it while it lasts."""

import shutil
from types import SimpleNamespace

import pytest

from engine.core.gate_state import HoldReason
from service.sessions.lifecycle import writer
from tests.support.service.api_calls import act
from tests.support.waiting import eventually

BEHIND = HoldReason.AUDIT_BEHIND


@pytest.fixture
def looks(monkeypatch):
    """The writer looks every 10 ms, and each look is counted."""
    seen = []
    monkeypatch.setattr(writer, "DISK_CHECK_S", 0.01)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: seen.append(path) or SimpleNamespace(free=2**40))
    return seen


def test_a_database_whose_file_was_taken_away_faults_the_gate_until_it_is_back(settings, looks, running):
    path = settings.data_dir / "tidegate.db"
    _expect_no_more_notices(running, looks)
    path.rename(path.with_suffix(".aside"))
    eventually(lambda: BEHIND in running.faults)
    running.faults.clear()
    eventually(lambda: BEHIND in running.faults)
    path.with_suffix(".aside").rename(path)
    _expect_no_more_notices(running, looks)


def test_another_file_in_its_place_is_not_the_database(settings, looks, running):
    path = settings.data_dir / "tidegate.db"
    path.rename(path.with_suffix(".aside"))
    shutil.copy(path.with_suffix(".aside"), path)
    eventually(lambda: BEHIND in running.faults)
    path.with_suffix(".aside").replace(path)
    _expect_no_more_notices(running, looks)


def test_a_full_disk_is_reported_again_and_again_so_that_no_acknowledgement_leads_to_a_beam(
    client, session_id, engine, monkeypatch
):
    """If it were reported once a second only, quick acknowledgements could have the beam on for most of it."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=1024))
    act(client, session_id, "start")
    eventually(lambda: engine.running.faults.count(HoldReason.DISK_LOW) >= 5, within_s=writer.DISK_CHECK_S)


def _expect_no_more_notices(running, looks):
    """From the second look on nothing is reported."""
    _await_looks(looks, 2)
    running.faults.clear()
    _await_looks(looks, 5)
    assert running.faults == []


def _await_looks(looks, more):
    wanted = len(looks) + more
    eventually(lambda: len(looks) >= wanted)
