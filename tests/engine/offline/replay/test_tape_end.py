"""The end of a tape: a bounded wait for its writer, and no hash while it is still being written."""

import threading
from types import SimpleNamespace

import pytest

from engine.offline.replay import tape_writer
from engine.offline.replay.recording_tap import RecordingTap
from engine.offline.replay.tape_file import SCHEMA, read_tape
from engine.offline.replay.tape_writer import TapeWriter, sha256_of
from service.core.settings.settings import Settings
from service.engine_host import session_tape
from service.engine_host.session_tape import SessionTape
from service.storage.files.motion_models import tape_path
from tests.support.replay.scripted_tape import NO_MODELS

LONG_S = 600.0
AT_ONCE_S = 60.0


@pytest.fixture
def gate():
    """An event that a slow thread waits for; set at teardown."""
    gate = threading.Event()
    yield gate
    gate.set()


@pytest.fixture
def recording(tmp_path, monkeypatch, gate):
    """A recording whose hash is not computed before the gate opens."""
    monkeypatch.setattr(tape_writer, "sha256_of", lambda _path: gate.wait(LONG_S) and "")
    path = tmp_path / "long.oni"
    path.write_bytes(b"")
    return path


@pytest.fixture
def writing(tmp_path, recording):
    tap = RecordingTap()
    writer = TapeWriter(tap, tmp_path / "a.tape", dict, NO_MODELS, recording=recording)
    writer.start()
    return tap, writer, tmp_path / "a.tape"


def test_a_recording_that_is_long_to_read_leaves_the_tape_whole_without_its_hash(writing, monkeypatch):
    monkeypatch.setattr(tape_writer, "HASH_WAIT_S", 0.05)
    tap, writer, path = writing
    tap.end()
    writer.join(AT_ONCE_S)
    assert not writer.is_alive()
    tape = read_tape(path)
    list(tape.turns())
    assert (tape.is_whole, tape.torn, tape.facts) == (True, None, {})


def test_a_torn_tape_does_not_wait_for_the_hash_at_all(writing, monkeypatch):
    monkeypatch.setattr(tape_writer, "HASH_WAIT_S", LONG_S)
    tap, writer, path = writing
    tap.end()
    tap.tear("the tape was not written in time")
    writer.join(AT_ONCE_S)
    assert not writer.is_alive()
    tape = read_tape(path)
    list(tape.turns())
    assert tape.torn == "the tape was not written in time"


def test_a_hash_that_is_known_soon_enough_is_on_the_tape(writing, gate):
    tap, writer, path = writing
    gate.set()
    tap.end()
    writer.join(AT_ONCE_S)
    tape = read_tape(path)
    list(tape.turns())
    assert tape.facts["recording_bytes"] == 0


class Slow(threading.Thread):
    """Writes the beginning of a tape, and the rest when the gate opens."""

    def __init__(self, gate, path):
        super().__init__(daemon=True)
        self._gate, self._path, self.begun = gate, path, threading.Event()

    def run(self):
        self._path.parent.mkdir(parents=True)
        self._path.write_bytes(SCHEMA.encode())
        self.begun.set()
        self._gate.wait(LONG_S)
        with self._path.open("ab") as file:
            file.write(b"the rest")


@pytest.fixture
def slow(tmp_path, monkeypatch, gate):
    """A session's tape, and the thread that writes it."""
    monkeypatch.setattr(session_tape, "JOIN_S", 0.02)
    writer = Slow(gate, tape_path(tmp_path, "s"))
    monkeypatch.setattr(session_tape, "TapeWriter", lambda *_arguments, **_options: writer)
    tape = SessionTape(SimpleNamespace(session_id="s", recording=None), Settings(data_dir=tmp_path))
    tape.start(None, None)
    writer.begun.wait(AT_ONCE_S)
    return tape, writer


def test_a_tape_that_is_still_being_written_has_no_hash_and_the_answer_stays(slow, gate):
    tape, writer = slow
    kept = tape.finish()
    assert kept["tape_sha256"] is None
    assert kept["tape_torn"] == "the tape was not written in time"
    assert "still being written" in kept["tape_detail"]
    gate.set()
    writer.join(AT_ONCE_S)
    assert tape.finish() == kept, "a repeated close returns the same"


def test_a_tape_that_is_written_is_known_by_its_hash(slow, gate, tmp_path):
    tape, writer = slow
    gate.set()
    writer.join(AT_ONCE_S)
    assert tape.finish() == {"tape_sha256": sha256_of(tape_path(tmp_path, "s")), "tape_torn": None}
