"""The audit as JSON lines in files that rotate, and on by a real syslog daemon over TLS: whole and in order."""

import contextlib
import json
import os
import signal

import pytest
from pydantic import ValidationError

from service.core.settings.settings import Settings
from service.storage import audit
from service.storage.audit import Event, verification
from service.storage.audit.export import verify_export
from service.storage.audit.log_file import FAILED, RESUMED, AuditLogFile
from tests.support.audit.rows import fill
from tests.support.audit.supervised_audit import SupervisedAudit
from tests.support.audit.syslog_certificates import Authority
from tests.support.audit.syslog_server import Collector, Sender
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow


class Desk:
    """A log file that is written one turn at a time."""

    def __init__(self, database, folder):
        self.database, self.folder = database, folder
        self.given = {"max_bytes": 10**6, "kept_files": 3, "after": 0, "with_patients": True}
        self.file = self.made()

    def made(self):
        self.file = AuditLogFile(database=self.database, folder=self.folder, write=self.write, **self.given)
        return self.file

    def write(self, event):
        with self.database.write() as db:
            audit.append(db, event)

    def lines(self):
        return [line for file in self.files() for line in file.read_bytes().split(b"\n") if line]

    def files(self):
        return sorted(self.folder.iterdir())

    def rows(self):
        """The numbers of the whole lines."""
        found = []
        for line in self.lines():
            with contextlib.suppress(ValueError):
                found.append(json.loads(line)["sequence"])
        return found

    def as_export(self):
        last = json.loads(self.lines()[-1])["hash"]
        end = {"schema": "tidegate.audit/1", "end": {"rows": len(self.lines()), "last_hash": last}}
        return [*(line.decode() for line in self.lines()), json.dumps(end)]

    def actions(self):
        with self.database.read() as db:
            return [link.action for link in verification.read_links(db, None, 1000)]


@pytest.fixture
def desk(database, tmp_path):
    return Desk(database, tmp_path / "log")


def test_every_row_is_a_line_that_is_verified_without_the_database(desk):
    desk.file.update()
    desk.write(Event(actor="A. Nurse <x>", action="user.login", detail={"text": "Grüße ☢\n\x01"}))
    desk.file.update()
    assert (desk.rows(), desk.file.written) == (list(range(1, 9)), 8)
    (file,) = desk.files()
    assert (file.name, file.stat().st_mode & 0o777) == ("audit-000000000001.jsonl", 0o640)
    assert verify_export(desk.as_export()).is_intact


def test_a_file_is_followed_by_another_before_it_is_too_large_and_so_many_are_kept(desk, database):
    desk.given["max_bytes"] = 1500
    desk.made()
    fill(database, 40)
    desk.file.update()
    files, rows = desk.files(), desk.rows()
    assert len(files) == 3
    assert max(file.stat().st_size for file in files) <= 1500
    assert [json.loads(file.read_text().splitlines()[0])["sequence"] for file in files] == [
        int(file.stem.partition("-")[2]) for file in files
    ]
    assert rows == list(range(rows[0], 48))
    assert rows[0] > 1


def test_a_row_that_is_longer_than_the_file_may_be_has_one_of_its_own(desk):
    desk.given["max_bytes"] = 1500
    desk.made()
    desk.write(Event(actor="me", action="test", detail={"text": "x" * 3000}))
    desk.write(Event(actor="me", action="test"))
    desk.file.update()
    assert desk.rows()[-2:] == [8, 9]
    assert [file.name for file in desk.files()[-2:]] == ["audit-000000000008.jsonl", "audit-000000000009.jsonl"]


@pytest.mark.parametrize("torn", [b"", b'{"sequence":9,"ha', b"\xff\x00"])
def test_a_restart_goes_on_behind_the_last_whole_line(desk, database, torn):
    desk.file.update()
    with desk.files()[0].open("ab") as file:
        file.write(torn)
    fill(database, 2)
    desk.made().update()
    desk.made().update()
    assert desk.rows() == list(range(1, 10))
    assert [line for line in desk.lines() if line == torn] == [torn] * bool(torn)


def test_without_a_file_it_begins_behind_the_rows_of_before(desk, database):
    desk.given["after"] = 7
    desk.made()
    fill(database, 1)
    desk.file.update()
    assert desk.rows() == [8]


def test_a_folder_that_takes_nothing_is_reported_and_nothing_is_lost(desk, database):
    desk.file.update()
    away = desk.folder.with_name("away")
    desk.folder.rename(away)
    desk.folder.write_text("in its place")
    fill(database, 2)
    desk.file.update()
    desk.file.update()
    assert "cannot be written" in desk.file.trouble
    assert "rows wait" in desk.file.trouble
    desk.folder.unlink()
    away.rename(desk.folder)
    desk.file.update()
    desk.file.update()
    assert desk.file.trouble is None
    assert [action for action in desk.actions() if action.startswith("audit.")] == [FAILED, RESUMED]
    assert desk.rows() == list(range(1, 12))


def test_a_full_disk_in_the_middle_of_a_batch_costs_no_row(desk, database, monkeypatch):
    fdopen, failures = os.fdopen, [OSError(28, "No space left on device")]

    class Full:
        def __init__(self, file):
            self._file = file

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self._file.close()

        def write(self, content):
            self._file.write(content[: len(content) // 2])
            self._file.flush()
            raise failures.pop()

    with monkeypatch.context() as patch:
        patch.setattr(os, "fdopen", lambda *given: Full(fdopen(*given)) if failures else fdopen(*given))
        desk.file.update()
    assert "No space left" in desk.file.trouble
    desk.file.update()
    assert desk.rows() == list(range(1, 9))


def test_after_a_restored_backup_it_goes_on_with_the_restore(desk, database):
    desk.folder.mkdir()
    (desk.folder / "audit-000000000400.jsonl").write_text('{"sequence":500,"hash":"gone"}\n')
    desk.write(Event(actor="tidegate", action="backup.restored"))
    fill(database, 1)
    desk.made().update()
    assert desk.rows() == [500, 8, 9]


def test_what_names_a_patient_is_left_out_unless_it_is_asked_for(desk):
    desk.write(Event(actor="me", action="session.create", detail={"patient_reference": "P-UNMISTAKABLE"}))
    desk.given["with_patients"] = False
    desk.made().update()
    assert "P-UNMISTAKABLE" not in "".join(desk.as_export())
    found = verify_export(desk.as_export())
    assert found.is_intact
    assert found.notes[0].startswith("1 rows without their detail")


# -- with rsyslog


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    return Authority(tmp_path_factory.mktemp("ca"), "ca")


@pytest.fixture(scope="module")
def our_pair(authority):
    return authority.pair("tidegate.test")


@pytest.fixture
def collector(tmp_path, authority):
    collector = Collector(tmp_path / "collector", ca_file=authority.file, pair=authority.pair("localhost")).start()
    yield collector
    collector.stop(signal.SIGKILL)


@pytest.fixture
def sender(desk, collector, tmp_path, authority, our_pair):
    sender = Sender(
        tmp_path / "sender", desk.folder, collector.port, name="localhost", ca_file=authority.file, pair=our_pair
    ).start()
    yield sender
    sender.stop(signal.SIGKILL)


def received(collector, last, *, within_s=30.0):
    """Wait until the collector has written this row, then give all it has."""

    def found():
        return [json.loads(message[message.index(b"{") :])["sequence"] for message in collector.messages()]

    eventually(lambda: last in found(), within_s=within_s, detail=lambda: f"row {last} has not come: {found()}")
    return found()


@pytest.mark.usefixtures("sender")
def test_the_collector_gets_every_row_once_through_a_rotation_and_an_outage(desk, collector, database):
    desk.given |= {"max_bytes": 3000, "kept_files": 20}
    desk.made().update()
    received(collector, 7)
    collector.stop(signal.SIGTERM)
    for _ in range(8):
        fill(database, 5)
        desk.file.update()
    assert len(desk.files()) > 3
    collector.start()
    fill(database, 1)
    desk.file.update()
    found = received(collector, 48)
    assert sorted(set(found)) == list(range(1, 49))
    message = collector.messages()[0]
    assert message.startswith(b"<85>1 ")
    assert b" tidegate - audit - {" in message
    assert verify_export([line[line.index(b"{") :].decode() for line in collector.messages()][:7]).rows == 7


def test_a_sender_that_was_stopped_goes_on_where_it_was(desk, collector, sender, database):
    desk.file.update()
    received(collector, 7)
    sender.stop(signal.SIGTERM)
    fill(database, 3)
    desk.file.update()
    sender.start()
    assert received(collector, 10) == list(range(1, 11))


@pytest.mark.parametrize("wrong", ["authority of the server", "name of the server", "authority of the sender"])
def test_nothing_goes_to_a_wrong_server_or_comes_from_an_unknown_sender(
    desk, collector, database, tmp_path, authority, our_pair, wrong
):
    other = Authority(tmp_path, "other")
    wrong = Sender(
        tmp_path / "wrong",
        desk.folder,
        collector.port,
        name="elsewhere.test" if wrong == "name of the server" else "localhost",
        ca_file=other.file if wrong == "authority of the server" else authority.file,
        pair=other.pair("tidegate.test") if wrong == "authority of the sender" else our_pair,
    ).start()
    right = Sender(
        tmp_path / "right", desk.folder, collector.port, name="localhost", ca_file=authority.file, pair=our_pair
    ).start()
    try:
        desk.file.update()
        assert received(collector, 7) == list(range(1, 8))  # by the right one, once
        fill(database, 1)
        desk.file.update()
        assert received(collector, 8) == list(range(1, 9))
    finally:
        wrong.stop(signal.SIGKILL)
        right.stop(signal.SIGKILL)


def test_a_service_with_a_log_file_writes_its_whole_life(database, tmp_path):
    folder = tmp_path / "log"
    supervised = SupervisedAudit(database, tmp_path, audit_log_dir=folder).run()
    supervised.run()
    (file,) = folder.iterdir()
    assert [json.loads(line)["sequence"] for line in file.read_text().splitlines()] == [8, 9, 10, 11]
    assert "service.stop" in file.read_text().splitlines()[-1]
    assert supervised.care.troubles == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"audit_log_max_mb": 0}, "greater than or equal to 1"),
        ({"audit_log_files": 0}, "greater than or equal to 1"),
    ],
)
def test_settings_that_lead_nowhere_are_refused(given, said):
    with pytest.raises(ValidationError, match=said):
        Settings(**given)
