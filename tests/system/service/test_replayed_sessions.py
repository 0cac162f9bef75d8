"""A session that the real service ran, run again: the same to the last bit, and anything else is found."""

import json
import os
import platform
import shutil
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select
from typer.testing import CliRunner

from engine.core.input_tap import InputKind
from engine.gating.windows import amplitude_window
from engine.offline.replay.comparison import this_machine
from engine.offline.replay.tape_file import read_tape
from service.cli import app
from service.core.settings.database_place import DATABASE_NAME
from service.sessions.recovery.replay import NotReplayableError, StoredSession, audit_differences
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow
from service.storage.files.motion_models import tape_path
from tests.support.processor_features import WITHOUT_AVX as FEWER_FEATURES
from tests.support.replay.real_sessions import SOON, DeliberatePerson, Played, Troubles, play
from tests.support.waiting import eventually

pytestmark = pytest.mark.long

TROUBLES = Troubles(silence=0.03, loss=0.02, hang=0.004)


@pytest.fixture(scope="module")
def played(tmp_path_factory, regular_volunteer):
    """A session with commands, a hold, silences, lost frames, an engine that hung, and a model learned meanwhile."""
    data_dir = tmp_path_factory.mktemp("played") / "data"
    return play(data_dir, regular_volunteer, seed=11, troubles=TROUBLES, window=SOON, person=DeliberatePerson())


@pytest.fixture
def copied(played, tmp_path):
    """A copy of its folder, to spoil."""
    return replace(played, data_dir=Path(shutil.copytree(played.data_dir, tmp_path / "copy")))


def stored(played: Played) -> StoredSession:
    return StoredSession(Database(played.data_dir / DATABASE_NAME), played.data_dir, played.session_id)


def again(played: Played, recording: Path | None = None):
    return stored(played).run_again(recording, lambda _frames: None)


@pytest.fixture(scope="module")
def verdict(played):
    return again(played)


def test_every_gate_edge_and_every_sample_is_the_same(played, verdict):
    assert verdict.differences == []
    assert verdict.replay.frames == verdict.samples == played.frames
    assert verdict.audited == len(verdict.replay.transitions) + len(verdict.replay.elsewhere)
    assert "beam_on" in {row["to"] for row in verdict.replay.transitions}
    assert verdict.replay.is_whole


def test_a_later_session_of_the_fraction_replays_the_same_with_its_first_reference(copied, regular_volunteer):
    later = play(copied.data_dir, regular_volunteer, seed=12, person=DeliberatePerson())
    first = stored(later).head.first_reference
    assert first is not None
    assert stored(copied).head.first_reference is None
    reported = [
        json.loads(row.detail)
        for row in audited(later)
        if row.action == "model.reference_set" and row.session_id == later.session_id
    ]
    assert reported
    for one in reported:
        assert "from the fraction's first" in one["detail"], "measured from a reference of an engine that is gone"
        assert one["distance_mm"] is not None
    assert again(later).differences == []


def test_a_later_fraction_of_the_plan_is_signed_before_its_beam_and_replays_the_same(copied, regular_volunteer):
    later = play(copied.data_dir, regular_volunteer, seed=13, person=DeliberatePerson(), fraction=9)
    head = stored(later).head
    assert head.first_reference is None
    assert head.plan_position is not None
    rows = [row for row in audited(later) if row.session_id == later.session_id]
    signed = next(row for row in rows if row.action == "session.position_check" and row.outcome == "done")
    armed = next(row for row in rows if row.action == "session.arm" and row.outcome == "done")
    assert signed.sequence < armed.sequence
    shown = json.loads(signed.detail)["shown"]
    assert [one["name"] for one in shown["degrees"]][:3] == ["lateral", "longitudinal", "vertical"]
    outcome = again(later)
    assert outcome.differences == []
    assert "beam_on" in {row["to"] for row in outcome.replay.transitions}


def test_what_happened_in_it_happened_indeed(played, verdict):
    observed = [reading for turn in turns(played) for reading in turn.observed]
    values = [(kind, encoded["d"][1]) for kind, encoded in observed if kind in {InputKind.TURN, InputKind.FRAME}]
    waiting = [value["commands"] for kind, value in values if kind is InputKind.TURN and "commands" in value]
    commands = [command["d"][0] for some in waiting for command in some["t"]]
    assert set(commands) >= {"Arm", "HoldBeam", "ReleaseBeam", "SetReference"}
    without = [value for kind, value in values if kind is InputKind.FRAME and "frame" not in value]
    assert without, "the camera was silent"
    assert sum(answer is True for kind, answer in observed if kind is InputKind.TRAINED) >= 1, "a model was learned"
    assert {row["state"] for turn in turns(played) for row in turn.rows if "state" in row} >= {"training", "measuring"}
    assert "operator_hold" in {row["reason"] for row in verdict.replay.transitions}


def turns(played: Played):
    return read_tape(tape_path(played.data_dir, played.session_id)).turns()


def test_the_command_states_it_in_a_line_writes_both_tables_and_reports_its_own_audit(copied, tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_DATA_DIR", str(copied.data_dir))
    answer = CliRunner().invoke(app, ["replay", copied.session_id, "--out", str(tmp_path / "out")])
    assert answer.exit_code == 0, answer.output
    assert f"identical: {copied.frames} frames" in answer.output
    motion = (tmp_path / "out" / "motion.csv").read_text().splitlines()
    assert len(motion) == copied.frames + 1
    assert "beam_on" in (tmp_path / "out" / "transitions.csv").read_text()
    assert actions(copied)[-1] == "session.replayed"


def actions(played: Played) -> list[str]:
    return [row.action for row in audited(played)]


def audited(played: Played) -> list[AuditRow]:
    with Database(played.data_dir / DATABASE_NAME).read() as db:
        return list(db.scalars(select(AuditRow).order_by(AuditRow.sequence)))


def test_a_window_a_hair_wider_is_found_and_the_command_fails(copied, monkeypatch):
    session = stored(copied)
    window = amplitude_window(lower_mm=-0.5, upper_mm=0.5)
    session.head = replace(session.head, limits=replace(session.head.limits, window=window))
    (difference,) = session.run_again(None, lambda _frames: None).differences
    assert difference.recorded != difference.replayed
    monkeypatch.setattr("engine.gating.gate.CYCLES_WITHIN_NS", 0)
    monkeypatch.setattr(
        "engine.control.gate_controller.captured_ns", lambda last, _measurement, _limits: last.received_ns - 1
    )
    wish = ["replay", copied.session_id, "--data", str(copied.data_dir)]
    answer = CliRunner().invoke(app, wish)
    assert (answer.exit_code, "DIFFERENT at frame" in answer.output) == (1, True), answer.output
    assert actions(copied).count("session.replayed") == 0, "a folder that was named is only read"


def test_another_recording_is_refused_and_so_is_a_tape_that_was_changed(copied, regular_volunteer, tmp_path):
    other = tmp_path / "other.oni"
    content = bytearray((regular_volunteer / "recording.oni").read_bytes())
    content[len(content) // 2] ^= 1
    other.write_bytes(content)
    with pytest.raises(NotReplayableError, match="SHA-256"):
        again(copied, other)
    path = tape_path(copied.data_dir, copied.session_id)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(NotReplayableError, match="was changed after the session was closed"):
        stored(copied)


def of_another_processor(played: Played, monkeypatch, *, change=None, machine=None) -> None:
    """Let a tape name other features in its head, and rows that ``change`` has changed."""
    path = tape_path(played.data_dir, played.session_id)
    lines = [json.loads(line) for line in zlib.decompress(path.read_bytes()).splitlines()]
    lines[0]["machine"] = this_machine() | {"opencv features": "SSE SSE2"} if machine is None else machine
    for line in lines[1:]:
        for row in line.get("r", []):
            if "digest" in row:
                row["digest"] = "of another processor"
            if change is not None:
                change(row)
    path.write_bytes(zlib.compress(b"".join(json.dumps(line).encode() + b"\n" for line in lines)))
    monkeypatch.setattr(StoredSession, "_refuse_changed_tape", lambda _self: None)


def more_mm(step_mm: float):
    """Change what is recorded by so much, as another order of the same sums does."""

    def change(row: dict) -> None:
        if row.get("whole_mm") is not None:
            row["whole_mm"] += step_mm

    return change


def replayed(played: Played):
    return CliRunner().invoke(app, ["replay", played.session_id, "--data", str(played.data_dir)])


def test_numbers_of_another_processor_agree_within_a_thousandth_of_a_millimetre_and_the_command_states_it(
    copied, monkeypatch
):
    of_another_processor(copied, monkeypatch, change=more_mm(5e-4))
    answer = replayed(copied)
    assert answer.exit_code == 0, answer.output
    assert f"agrees within 0.001 mm, gate decisions are equal: {copied.frames} frames" in answer.output
    assert f"identical to the last bit: 0 of {copied.frames} frames" in answer.output
    assert "opencv features SSE SSE2 there" in " ".join(answer.output.split())


def test_larger_differences_of_another_processor_are_differences(copied, monkeypatch):
    of_another_processor(copied, monkeypatch, change=more_mm(2e-3))
    answer = replayed(copied)
    assert answer.exit_code == 1, answer.output
    assert "numbers differ by more than 0.001 mm" in answer.output


def test_another_decision_on_another_processor_is_named_at_its_first_frame(copied, monkeypatch):
    flipped = []

    def flip(row: dict) -> None:
        if row.get("gate") == "beam_on" and not flipped:
            flipped.append(row["frame"])
            row |= {"gate": "hold", "reason": "outside_window"}

    of_another_processor(copied, monkeypatch, change=flip)
    answer = replayed(copied)
    assert answer.exit_code == 1, answer.output
    assert f"DIFFERENT at frame {flipped[0]}" in answer.output
    assert "different decision" in answer.output
    assert "recorded: gate hold, reason outside_window, whole_mm" in answer.output


def test_a_tape_that_does_not_name_features_is_replayed_within_rounding(copied, monkeypatch):
    older = ("processor", "python", "numpy", "opencv", "scipy")
    of_another_processor(copied, monkeypatch, machine={name: this_machine()[name] for name in older})
    found = again(copied)
    assert (found.differences, found.comparison.is_exact, found.is_identical) == ([], False, False)
    assert "opencv features unknown there" in found.notes[0]


def test_samples_of_another_processor_are_compared_cell_by_cell(copied, monkeypatch):
    from service.sessions.recovery import replay

    usual = replay.sample_values

    def moved(record):
        values = usual(record)
        return values if values["regions_mm"] is None else values | {"regions_mm": values["regions_mm"] + step_mm}

    of_another_processor(copied, monkeypatch)
    monkeypatch.setattr(replay, "sample_values", moved)
    step_mm = 5e-4
    assert again(copied).differences == []
    step_mm = 2e-3
    (difference,) = again(copied).differences
    assert "regions_mm" in difference.recorded


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the setting names features of x86-64")
def test_other_features_of_this_processor_give_the_same_decisions(copied):
    """For real: a session of this process, replayed by one that does without the newer vector instructions."""
    wish = [sys.executable, "-m", "service.cli", "replay", copied.session_id, "--data", str(copied.data_dir)]
    answer = subprocess.run(wish, env=os.environ | FEWER_FEATURES, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    has_fewer_already = FEWER_FEATURES.items() <= os.environ.items()  # where `make processors` runs this
    expected = "identical:" if has_fewer_already else "agrees within 0.001 mm, gate decisions are equal"
    assert expected in answer.stdout


def differences(verdict, audited, *, is_torn=False, is_open=False):
    return audit_differences(verdict.replay, audited, is_torn=is_torn, is_open=is_open)


def test_a_transition_that_is_missing_from_the_audit_or_was_altered_there_is_found(played, verdict):
    audited = stored(played)._audited()
    assert differences(verdict, audited) == []
    for place in range(len(audited)):
        without = audited[:place] + audited[place + 1 :]
        (difference,) = differences(verdict, without)
        assert difference.recorded != difference.replayed
        altered = [*audited[:place], audited[place] | {"decided_ns": audited[place]["decided_ns"] + 1}]
        assert differences(verdict, altered + audited[place + 1 :])
        # The watchdog's own transitions, those of a busy machine, have no place among the decisions of the frames.
        has_place = audited[place]["reason"] != "watchdog" and place < len(audited) - 1
        assert differences(verdict, [*without, audited[place]]) or not has_place, "another order"
    assert differences(verdict, [*audited, audited[-1]])


def test_an_audit_may_end_before_a_tape_only_while_its_session_is_open_and_after_it_only_where_it_is_torn(
    played, verdict
):
    audited = stored(played)._audited()
    assert differences(verdict, audited[:-1], is_open=True) == []
    assert differences(verdict, [*audited, audited[0]], is_torn=True) == []
    assert differences(verdict, audited[1:], is_torn=True, is_open=True) != []


def test_a_session_that_is_not_there_or_ran_as_another_version_is_refused(copied):
    wish = ["replay", "0" * 32, "--data", str(copied.data_dir)]
    assert CliRunner().invoke(app, wish).exit_code == 2
    assert CliRunner().invoke(app, ["replay", "x", "--data", "/nowhere"]).exit_code == 2
    session = stored(copied)
    session.head = replace(session.head, software="tidegate 0.0.1")
    with pytest.raises(NotReplayableError, match="--any-version"):
        session.refuse_other_version()
    tape_path(copied.data_dir, copied.session_id).unlink()
    with pytest.raises(NotReplayableError, match="no tape"):
        stored(copied)


def test_a_session_whose_service_was_killed_is_replayed_up_to_the_tear(tmp_path, regular_volunteer):
    data_dir = tmp_path / "data"
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.support.replay.killed_program", str(data_dir), str(regular_volunteer)]
    )
    try:

        def is_recorded() -> bool:
            assert child.poll() is None, "it ended by itself"
            return _has_been_on(data_dir) and _is_on_tape(data_dir)

        eventually(is_recorded, within_s=100.0, pause_s=0.05, detail=lambda: "the beam was never on")
    finally:
        child.kill()
        child.wait()
    (tape,) = (data_dir / "replays").iterdir()
    killed = Played(data_dir=data_dir, session_id=tape.stem, status="running", frames=0)
    found = again(killed)
    assert found.differences == []
    assert not found.replay.is_whole
    assert found.replay.frames > 100
    assert "beam_on" in {row["to"] for row in found.replay.transitions}
    assert any("up to the tear" in note for note in found.notes)


def _is_on_tape(data_dir: Path) -> bool:
    """Whether the tape has come so far too: it is written a tenth of a second behind the audit."""
    (path,) = (data_dir / "replays").iterdir()
    return any(row.get("to") == "beam_on" for turn in read_tape(path).turns() for row in turn.rows)


def _has_been_on(data_dir: Path) -> bool:
    if not (data_dir / "replays").is_dir():
        return False
    database = Database(data_dir / DATABASE_NAME)
    try:
        from service.storage.database.tables import AuditRow

        with database.read() as db:
            rows = db.query(AuditRow.detail).filter(AuditRow.action == "gate.transition").all()
    finally:
        database.close()
    return any(json.loads(detail)["to_state"] == "beam_on" for (detail,) in rows)
