"""What a service does for its audit from its start to its end: looks back, says what changed, keeps heads, looks on."""

import json
import logging
from datetime import UTC, datetime, timedelta

import pytest
from pydantic_settings import BaseSettings
from sqlalchemy.exc import OperationalError

from engine.core.clock import NS_PER_S, ManualClock
from service.core.settings.settings import Settings
from service.storage import audit
from service.storage.audit import Breakage, Event, supervision as care_module
from service.storage.audit.anchors import AnchorFile, note_restore
from service.storage.audit.check import LOST_FILE, changes, check_tail, check_whole, redacted_settings, settings_sha256
from service.storage.audit.supervision import AnchorWriter, ClockWatch
from service.storage.audit.verification import read_links
from tests.support.audit.rows import fill
from tests.support.audit.supervised_audit import NOW, SupervisedAudit


@pytest.fixture
def supervised(database, tmp_path):
    return SupervisedAudit(database, tmp_path)


def cut_off(raw, after):
    raw.execute("DELETE FROM audit WHERE sequence > ?", (after,))
    raw.commit()


def test_a_start_states_its_software_its_settings_and_their_hash(supervised):
    supervised.run()
    (start,) = supervised.rows("service.start")
    assert start["version"] == "1.2.3"
    assert start["settings"]["audit_log_max_mb"] == 10
    assert start["settings_sha256"] == settings_sha256(start["settings"])
    assert start["anchors"] is None


def test_heads_are_kept_at_the_stop_and_the_next_start_finds_all_in_order(supervised, database):
    supervised.run()
    assert (supervised.file.last().kind, supervised.file.last().sequence) == ("stop", 9)
    supervised.run()
    assert supervised.care.troubles == []
    assert supervised.rows("service.start")[1]["anchors"]["size_bytes"] > 0
    assert supervised.rows("audit.broken") == []
    assert check_whole(database, supervised.file).is_intact


def test_changed_settings_are_written_down_old_and_new(supervised, database, tmp_path):
    supervised.run()
    SupervisedAudit(database, tmp_path, lease_ms=70.0, site_name="Ward 7").run()
    (changed,) = supervised.rows("settings.changed")
    assert changed["changed"] == {"lease_ms": {"old": 80.0, "new": 70.0}, "site_name": {"old": "", "new": "Ward 7"}}
    SupervisedAudit(database, tmp_path, lease_ms=70.0, site_name="Ward 7").run()
    assert len(supervised.rows("settings.changed")) == 1


def test_a_setting_that_came_or_went_with_another_version_is_a_change():
    event = changes({"settings": {"old_one": 1}, "version": "1"}, {"new_one": 2})
    assert event.detail["changed"] == {
        "new_one": {"old": "(there was no such setting)", "new": 2},
        "old_one": {"old": 1, "new": "(there was no such setting)"},
    }
    assert changes({}, {"new_one": 2}) is None
    assert changes({"settings": {"one": 1}}, {"one": 1}) is None


def test_no_secret_is_recorded(tmp_path):
    url = "postgresql://gate:topsecret@localhost/tidegate"
    reported = redacted_settings(Settings(data_dir=tmp_path, database_url=url))
    assert "topsecret" not in json.dumps(reported)


class Careless(BaseSettings):
    """Settings whose maker forgot that a secret is one."""

    api_token: str = "topsecret"
    key_file: str = "key.pem"
    keyboard: str = "qwerty"


def test_a_setting_named_like_a_secret_is_redacted_too():
    assert redacted_settings(Careless()) == {"api_token": "(not told)", "key_file": "key.pem", "keyboard": "qwerty"}


@pytest.mark.parametrize("cut", [8, 5, 1])
def test_newest_rows_cut_off_are_reported_loudly_at_the_next_start(supervised, raw, caplog, cut):
    supervised.run()
    cut_off(raw, cut)
    supervised.run()
    assert "rows were cut off" in supervised.rows("audit.broken")[0]["detail"]
    assert "rows were cut off" in supervised.care.troubles[0]
    assert [record.levelno for record in caplog.records if "broken" in record.message] == [logging.CRITICAL]
    found = check_whole(supervised.database, supervised.file)
    assert not found.is_intact


def test_another_database_in_its_place_is_reported_at_the_next_start(supervised, database, tmp_path):
    supervised.run()
    other = database.twin(busy_timeout_s=1.0, answer_timeout_s=None)
    other.close()
    (tmp_path / "audit.db").unlink()
    database.close()
    database.migrate()
    fill(database, 30)
    supervised.run()
    assert "changed, or replaced" in supervised.care.troubles[0]
    found = check_whole(database, supervised.file)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.REPLACED, 9)


def test_a_row_changed_since_the_newest_head_is_reported_at_the_next_start(supervised, raw):
    supervised.run()
    fill(supervised.database, 3)
    raw.execute("UPDATE audit SET actor = 'you' WHERE sequence = 11")
    raw.commit()
    assert check_tail(supervised.database, supervised.file) == "row 11 was changed after it was written"


def test_a_row_changed_before_the_newest_head_is_left_to_the_whole_check(supervised, raw):
    supervised.run()
    raw.execute("UPDATE audit SET actor = 'you' WHERE sequence = 3")
    raw.commit()
    assert check_tail(supervised.database, supervised.file) is None
    assert check_whole(supervised.database, supervised.file).first_broken_sequence == 3


@pytest.mark.parametrize("way", ["gone", "cut", "another"])
def test_a_file_of_heads_that_lost_lines_is_reported(supervised, way):
    supervised.run()
    supervised.run()
    lines = supervised.file.path.read_text().splitlines(keepends=True)
    supervised.file.path.unlink()
    if way == "cut":
        supervised.file.path.write_text("".join(lines[:-2]))
    if way == "another":
        supervised.file.path.write_text("".join(lines).replace('"stop"', '"STOP"'))
    assert check_tail(supervised.database, supervised.file) == LOST_FILE
    found = check_whole(supervised.database, supervised.file)
    assert found.breakage is Breakage.ANCHORS


def test_a_restored_backup_is_distinguished_from_rows_cut_off(supervised, raw, database):
    supervised.run()
    cut_off(raw, 5)
    with database.read() as db:
        head = read_links(db, None, 100)[-1]
    note_restore(supervised.file.path, sequence=head.sequence, head_hash=head.hash, source="backup-1")
    supervised.run()
    assert supervised.care.troubles == []
    found = check_whole(database, supervised.file)
    assert found.is_intact
    assert "a backup that ends with row 5 was restored" in found.notes[0]


def test_a_restored_backup_on_another_machine_knows_another_file_of_heads(supervised, database):
    supervised.run()
    with database.read() as db:
        head = read_links(db, None, 100)[-1]
    supervised.file.path.unlink()
    note_restore(supervised.file.path, sequence=head.sequence, head_hash=head.hash, source="backup-1")
    assert check_tail(database, supervised.file) is None
    assert check_whole(database, supervised.file).is_intact


def test_a_false_restore_that_does_not_fit_the_rows_is_found(supervised, raw, database):
    supervised.run()
    cut_off(raw, 5)
    note_restore(supervised.file.path, sequence=5, head_hash="ab" * 32, source="")
    assert "changed, or replaced" in check_tail(database, supervised.file)
    assert check_whole(database, supervised.file).breakage is Breakage.REPLACED


def test_a_file_that_hangs_holds_no_start_up(supervised, monkeypatch):
    monkeypatch.setattr(care_module, "ANSWER_S", 0.05)
    waiting = care_module.threading.Event()
    monkeypatch.setattr(care_module, "check_tail", lambda *_: waiting.wait(20.0))
    supervised.start()
    waiting.set()
    supervised.stop()
    assert supervised.rows("service.start")[0]["anchors"] == "the anchor file has not answered for 0.05 s"


def test_a_clock_set_back_while_nothing_ran_is_written_down(supervised):
    supervised.run(now=datetime(2020, 1, 1, tzinfo=UTC))
    (reported,) = supervised.rows("clock.changed")
    assert reported["after"] == "2020-01-01T00:00:00+00:00"
    assert reported["jump_ms"] < 0


class Clocks:
    """Both clocks, set by hand."""

    def __init__(self):
        self.monotonic, self.wall, self.events = ManualClock(), NOW, []
        self.watch = ClockWatch(clock=self.monotonic, now=lambda: self.wall, jump_ms=500.0, write=self.events.append)

    def go(self, *, monotonic_s, wall_s):
        self.monotonic.advance_ns(round(monotonic_s * NS_PER_S))
        self.wall += timedelta(seconds=wall_s)
        self.watch.check()
        return self.events


def test_clocks_that_go_together_are_no_event():
    clocks = Clocks()
    for _ in range(10):
        assert clocks.go(monotonic_s=1.0, wall_s=1.04) == []


@pytest.mark.parametrize(
    ("wall_s", "jump_ms"), [(1.501, 501.0), (0.499, -501.0), (3601.0, 3_600_000.0), (-3599.0, -3_600_000.0)]
)
def test_a_set_clock_is_written_down_once_with_before_and_after(wall_s, jump_ms):
    clocks = Clocks()
    (event,) = clocks.go(monotonic_s=1.0, wall_s=wall_s)
    assert (event.action, event.detail["jump_ms"]) == ("clock.changed", jump_ms)
    assert event.detail["before"] == (NOW + timedelta(seconds=1)).isoformat()
    assert event.detail["after"] == (NOW + timedelta(seconds=wall_s)).isoformat()
    assert clocks.go(monotonic_s=1.0, wall_s=1.0) == [event]


@pytest.mark.parametrize("wall_s", [1.499, 0.501])
def test_a_jump_within_the_bound_is_no_event_and_adds_up(wall_s):
    clocks = Clocks()
    assert clocks.go(monotonic_s=1.0, wall_s=wall_s) == []
    assert len(clocks.go(monotonic_s=1.0, wall_s=wall_s)) == 1


def test_a_jump_that_could_not_be_written_down_is_seen_again():
    clocks = Clocks()

    def refuse(event):
        raise OperationalError("", {}, OSError())

    clocks.watch._write = refuse
    with pytest.raises(OperationalError):
        clocks.go(monotonic_s=1.0, wall_s=9.0)
    clocks.watch._write = clocks.events.append
    assert len(clocks.go(monotonic_s=1.0, wall_s=1.0)) == 1


class Keeping:
    """A keeper that looks on request, on a clock set by hand."""

    def __init__(self, database, tmp_path):
        self.database, self.clock, self.events = database, ManualClock(), []
        self.file = AnchorFile(tmp_path / "share" / "anchors.jsonl")
        self.keeper = AnchorWriter(
            database=database, file=self.file, clock=self.clock, interval_s=60.0, write=self.events.append, after=7
        )

    def look(self, *actions, after_s=1.0):
        with self.database.write() as db:
            for action in actions:
                audit.append(db, Event(actor="me", action=action))
        self.clock.advance_ns(round(after_s * NS_PER_S))
        self.keeper.update()
        return [(head.sequence) for head in self.file.heads()]


@pytest.fixture
def keeping(database, tmp_path):
    (tmp_path / "share").mkdir()
    return Keeping(database, tmp_path)


def test_while_rows_come_a_head_is_kept_once_a_minute(keeping):
    assert keeping.look("test") == [8]
    for _ in range(59):
        keeping.look("test")
    assert keeping.look() == [8, 67]
    assert keeping.look(after_s=600.0) == [8, 67]


@pytest.mark.parametrize("action", ["session.start", "session.close", "service.start", "service.stop"])
def test_a_session_s_start_and_end_are_kept_at_once(keeping, action):
    keeping.look("test")
    assert keeping.look("test") == [8]
    assert keeping.look(action, "test") == [8, 11]


def test_many_rows_at_once_are_one_head(keeping, monkeypatch):
    monkeypatch.setattr("service.storage.audit.supervision.BATCH_ROWS", 3)
    assert keeping.look(*["session.start"] * 10) == [17]


def test_a_share_that_is_away_is_reported_once_and_asked_no_more_often(keeping, caplog):
    (share := keeping.file.path.parent).rmdir()
    assert keeping.look("session.start") == []
    assert "cannot be kept" in keeping.keeper.trouble
    for _ in range(10):
        keeping.look("session.start")
    assert [event.action for event in keeping.events] == ["audit.anchors_failed"]
    assert len(caplog.records) == 1
    share.mkdir()
    assert keeping.look() == []
    assert keeping.look(after_s=60.0) == [18]
    assert keeping.keeper.trouble is None
    assert [event.action for event in keeping.events] == ["audit.anchors_failed", "audit.anchors_resumed"]


def test_a_share_that_never_answers_is_reported_while_it_hangs(keeping, monkeypatch):
    reported = []

    def hang(*_, **__):
        keeping.clock.advance_ns(9 * NS_PER_S)
        reported.append(keeping.keeper.trouble)
        keeping.clock.advance_ns(NS_PER_S)
        reported.append(keeping.keeper.trouble)

    monkeypatch.setattr(keeping.file, "append", hang)
    keeping.look("test")
    assert reported[0] is None
    assert "has not answered for 10 s" in reported[1]
    assert keeping.keeper.trouble is None


def test_a_disk_that_takes_half_a_line_is_trouble(keeping, monkeypatch):
    monkeypatch.setattr(
        "service.storage.audit.anchors.os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left"))
    )
    keeping.look("test")
    assert "No space left" in keeping.keeper.trouble
