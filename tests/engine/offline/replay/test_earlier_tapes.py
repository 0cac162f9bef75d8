"""Tapes that an earlier version wrote are read; they replay up to the first number that a later method changed."""

import dataclasses
import enum
import json
import re
import zlib
from contextlib import closing

import pytest
from typer.testing import CliRunner

from engine.capture.source import SourceDescription
from engine.core.commands import ActivateModel, Arm
from engine.core.gate_state import GateState
from engine.core.motion_model import MotionModel
from engine.gating.supervision import repeated_frames
from engine.motion.learning import training_set
from engine.offline.replay.comparison import ADDED
from engine.offline.replay.encoding import TapeEncoding
from engine.offline.replay.header import FIRST_METHOD, METHOD, this_software
from engine.offline.replay.tape_file import read_tape
from service.cli import app
from service.core.settings.database_place import DATABASE_NAME
from service.sessions.recovery.replay import NotReplayableError, StoredSession
from service.storage.database.engine import Database
from service.storage.files.motion_models import MODELS_FOLDER, ModelStore
from service.storage.files.tapes import tape_path
from tests.support import earlier_files
from tests.support.earlier_files import KILLED, LEARNING, RESUMED, TAPE
from tests.support.replay import earlier_cycles, scripted_tape

FRAMES = {LEARNING: 281, RESUMED: 238}
TRANSITIONS = {LEARNING: 21, RESUMED: 33}
CLASSES = 24
ENUMS = 7
INPUTS = 17
COMMANDS = 5
"""How many kinds of input a turn of ``tidegate.tape/1`` may have, and the number of the one for commands."""


@pytest.fixture(autouse=True)
def method_1(monkeypatch):
    """Compare as many earlier pictures as the version of the tapes, and count cycles as it did."""
    monkeypatch.setattr(repeated_frames, "EARLIER_PICTURES", 8)
    monkeypatch.setattr(training_set, "count_cycles", earlier_cycles.count_cycles)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The folders, with their databases upgraded."""
    found = earlier_files.unpacked("folders.tar.xz", tmp_path_factory.mktemp("folders"))
    for place in found.rglob(DATABASE_NAME):
        with closing(Database(place)) as database:
            database.migrate()
    return found


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return earlier_files.unpacked("recording.tar.xz", tmp_path_factory.mktemp("recording")) / "recording.oni"


@pytest.fixture(scope="module")
def encoding(folders):
    """An encoding that returns one of the stored models for every name."""
    path = min((folders / "data" / MODELS_FOLDER).glob("*.npz"))
    model = ModelStore(path.parent).load(path.stem)
    return TapeEncoding(name_of=lambda _model: "model", model_of=lambda _name: model)


def without_classes(value):
    """Encode a value as a tape does, without the names of classes."""
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, MotionModel):
        return "model"
    if dataclasses.is_dataclass(value):
        return {field.name: without_classes(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, list | tuple):
        return [without_classes(one) for one in value]
    if isinstance(value, frozenset):
        return sorted(without_classes(one) for one in value)
    return value


def without_names(encoded):
    """Drop the names of classes from a tape's values."""
    if not isinstance(encoded, dict):
        return encoded
    ((kind, body),) = encoded.items()
    match kind:
        case "e":
            return body[1]
        case "d":
            return {name: without_names(one) for name, one in body[1].items()}
        case "m":
            return "model"
        case "s":
            return sorted(without_names(one) for one in body)
    return [without_names(one) for one in body]


def lacking(written, read, path=""):
    """Name the places where a read value lacks or alters what is on the tape; it may have new fields."""
    if isinstance(written, dict) and isinstance(read, dict):
        return [found for name in written for found in lacking(written[name], read.get(name), f"{path}.{name}")]
    if isinstance(written, list) and isinstance(read, list) and len(written) == len(read):
        return [found for place, one in enumerate(written) for found in lacking(one, read[place], f"{path}[{place}]")]
    return [] if written == read else [f"{path}: {written!r} was written, {read!r} is read"]


def names_in(encoded, kind):
    """Collect the names of the classes ("d") or enums ("e") in encoded values."""
    if isinstance(encoded, dict):
        own = {body[0] for key, body in encoded.items() if key == kind}
        return own.union(*(names_in(body, kind) for body in encoded.values()))
    return set().union(*(names_in(one, kind) for one in encoded)) if isinstance(encoded, list) else set()


def test_every_class_and_every_enum_that_a_tape_names_is_read_with_all_that_it_held(encoding):
    values = read_tape(TAPE).head["values"]
    assert len(names_in(values, "d")) == CLASSES
    assert len(names_in(values, "e")) == ENUMS
    for encoded in values["l"]:
        assert lacking(without_names(encoded), without_classes(encoding.decode(encoded))) == [], encoded
    read = encoding.decode(values)
    assert any(isinstance(value, Arm) for value in read)
    assert any(isinstance(value, ActivateModel) for value in read)
    assert any(isinstance(value, SourceDescription) for value in read)


def test_an_earlier_scripted_session_comes_out_the_same(encoding, monkeypatch):
    monkeypatch.setattr(scripted_tape, "NO_MODELS", encoding)
    tape = read_tape(TAPE)
    limits = encoding.decode(tape.head["limits"])
    rows = [row for turn in tape.turns() for row in turn.rows]
    again = scripted_tape.replayed(TAPE, limits)
    assert again.difference is None
    assert again.frames == sum("gate" in row for row in rows) > 150
    known = [{name: value for name, value in row.items() if name not in ADDED} for row in again.transitions]
    assert known == [row for row in rows if "to" in row]
    assert {row["armed_by"] for row in again.transitions} >= {"A. Therapist"}
    states = {row["to"] for row in again.transitions}
    assert states == {"disarmed", "hold", "dwell", "beam_on", "fault"} == {state.value for state in GateState}
    assert {row["reason"] for row in again.transitions} >= {"operator_hold", "operator_lost", "disk_low"}


@pytest.mark.parametrize("session_id", [LEARNING, RESUMED])
def test_an_earlier_session_replays_up_to_the_first_number_of_another_method(folders, recording, session_id):
    data = folders / "data"
    with closing(Database(data / DATABASE_NAME)) as database:
        stored = StoredSession(database, data, session_id)
        with pytest.raises(NotReplayableError, match=f"ran as {stored.head.software}, this is {this_software()}"):
            stored.refuse_other_version()
        of_this_version = dataclasses.replace(stored.head, software=this_software())
        stored.head, earlier = of_this_version, stored.head
        with pytest.raises(NotReplayableError, match=f"measured with method {FIRST_METHOD}, .* method {METHOD}"):
            stored.refuse_other_version()
        stored.head = earlier
        verdict = stored.run_again(recording, lambda _frames: None)
    assert verdict.head.method == FIRST_METHOD
    assert verdict.head.limits.max_duty_percent == 100.0, "armed with any window"
    assert any("differences may be intended" in note for note in verdict.notes)
    assert verdict.audited == TRANSITIONS[session_id]
    assert 0 < verdict.replay.frames <= FRAMES[session_id]
    assert all(one.is_of_numbers and one.frame > 0 for one in verdict.differences)
    if not verdict.differences:
        assert verdict.replay.is_whole
        assert verdict.replay.frames == verdict.samples == FRAMES[session_id]


@pytest.mark.parametrize("session_id", [LEARNING, RESUMED, KILLED])
def test_the_command_replays_an_earlier_session_and_names_the_methods(folders, recording, session_id):
    data = folders / ("killed/data" if session_id == KILLED else "data")
    wish = ["replay", session_id, "--data", data, "--recording", recording]
    assert CliRunner().invoke(app, [str(word) for word in wish]).exit_code == 2
    answer = CliRunner().invoke(app, [*(str(word) for word in wish), "--any-version"])
    assert answer.exit_code in {0, 1}, answer.output
    assert f"method {FIRST_METHOD}" in answer.output
    agreed = re.search(r"(\d+) frames, \d+ transitions|after (\d+) frames that agree", answer.output)
    assert int(agreed[1] or agreed[2]) > 0


def test_the_command_refuses_a_database_that_is_not_upgraded(tmp_path):
    data = earlier_files.unpacked("folders.tar.xz", tmp_path) / "data"
    answer = CliRunner().invoke(app, ["replay", LEARNING, "--data", str(data)])
    assert answer.exit_code == 2, answer.output
    assert "tidegate database upgrade" in " ".join(answer.output.split())


def lines_of(path):
    """Read a tape's lines without the engine: head, turns, end."""
    return [json.loads(line) for line in zlib.decompress(path.read_bytes()).splitlines()]


def test_the_tapes_hold_every_kind_of_input_every_command_and_faults(folders):
    paths = [TAPE, *(tape_path(folders / "data", one) for one in (LEARNING, RESUMED))]
    turns = [line for path in paths for line in lines_of(path) if "h" in line]
    observed = [pair for turn in turns for pair in zip(turn["h"][::2], turn["h"][1::2], strict=True)]
    assert {kind for kind, _ in observed} == set(range(1, INPUTS + 1))
    commands = set().union(*(names_in(answer, "d") for kind, answer in observed if kind == COMMANDS))
    assert len(commands) == 10, commands
    faults = {
        row["reason"] for turn in turns for row in turn.get("r", []) + turn.get("e", []) if row.get("to") == "fault"
    }
    assert faults >= {"watchdog", "disk_low"}
