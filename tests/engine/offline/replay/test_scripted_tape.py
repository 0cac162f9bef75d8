"""Tapes of a scripted loop: what is on them, and that another engine, another frame or another answer is found."""

import random
import threading
from dataclasses import replace

import pytest

from engine.control.turn_inputs import CommandInputs
from engine.core.commands import Acknowledge, Arm, CorrectBaseline, Disarm, HoldBeam, ReleaseBeam, Retrain, SetReference
from engine.core.errors import BeamLineError, RecordingError, SourceAwayError, SourceLostError
from engine.core.gate_state import HoldReason
from engine.core.input_tap import InputKind
from engine.gating.active_window import SetWindow
from engine.gating.windows import amplitude_window
from engine.offline.replay.comparison import within_rounding
from engine.offline.replay.outcomes import text_of
from engine.offline.replay.replaying_tap import ReplayingTap
from engine.offline.replay.tape_file import RecordedTurn, TapeFile, read_tape
from tests.support.control.loop_bench import after, good, raising, silent
from tests.support.gating.streams import MS
from tests.support.replay.scripted_tape import NO_MODELS, lived, replayed, taped, with_limits
from tests.support.repository import DATA

pytestmark = pytest.mark.slow

FAULTS = (HoldReason.DISK_LOW, HoldReason.AUDIT_BEHIND, HoldReason.RECORDER_BEHIND)
ARM = Arm(operator="A. Therapist")
ANOTHER_WINDOW = SetWindow(
    operator="B",
    window=amplitude_window(lower_mm=-1.5, upper_mm=3.5),
    dwell_ms=120.0,
    min_on_ms=0.0,
    min_off_ms=0.0,
    max_cycles_per_min=60,
)


@pytest.fixture
def busy(tmp_path):
    """A tape of a session in which a person does everything there is to do."""
    one = taped()
    ask = lambda command: after(lambda: one.loop.submit(command))  # noqa: E731
    script = [
        *(good for _ in range(5)),
        ask(ARM),
        *(good for _ in range(10)),
        ask(HoldBeam(operator="B")),
        *(good for _ in range(3)),
        ask(ReleaseBeam(operator="B")),
        *(good for _ in range(10)),
        silent,
        *(good for _ in range(10)),
        after(lambda: one.loop.report_fault(HoldReason.DISK_LOW, "almost full")),
        *(good for _ in range(3)),
        ask(Acknowledge(operator="B")),
        ask(SetReference(operator="B")),
        ask(Retrain(operator="B", keeps_zero=False)),
        ask(CorrectBaseline(operator="B", by=0.25)),
        ask(ANOTHER_WINDOW),
        ask(ARM),
        *(good for _ in range(10)),
        ask(Disarm(operator="A. Therapist")),
        good,
    ]
    return lived(script, one), one.write(tmp_path / "busy.tape")


def test_a_session_with_every_command_replays_the_same(busy):
    one, path = busy
    again = replayed(path)
    assert again.difference is None
    assert again.frames == one.source.frames
    assert [row["to"] for row in again.transitions].count("beam_on") >= 2, "it was on, and on again"


def test_a_tape_of_values_that_was_written_before_replays_the_same():
    again = replayed(DATA / "tapes" / "scripted.tape", comparison=within_rounding())
    assert again.difference is None
    assert (again.frames, [row["to"] for row in again.transitions].count("beam_on")) == (62, 4)


@pytest.mark.parametrize("kind", [kind for kind in InputKind if kind.name in {"TURN", "COMMAND", "DECISION", "LINE"}])
def test_a_value_of_another_class_is_damage(kind):
    turn = RecordedTurn(observed=[(kind, NO_MODELS.encode(ARM))], rows=[], elsewhere=[])
    tap = ReplayingTap(iter([turn]), NO_MODELS, lambda _head: None)
    with pytest.raises(RecordingError, match=f"damaged: {kind.name} is a Arm"):
        tap.observe(kind, lambda: None)


def by_chance(one, seed):
    """Make a script in which anything may come between two frames."""
    chance = random.Random(seed)
    wishes = (Arm, Arm, Arm, Disarm, HoldBeam, ReleaseBeam, Acknowledge, Acknowledge, SetReference, Retrain)

    def ask():
        command = chance.choice(wishes)(operator=chance.choice(["A", "B"]))
        chance.random() < 0.5 and one.loop.note_presence("A")
        one.loop.submit(command)

    def step():
        draw = chance.random()
        if draw < 0.2:
            return after(ask)
        if draw < 0.23:
            return silent
        if draw < 0.25:
            return raising(SourceAwayError("unplugged"))
        if draw < 0.27:
            return after(lambda: one.loop.report_fault(chance.choice(FAULTS), "by chance"))
        return after(lambda: one.source.clock.advance_ns(50 * MS)) if draw < 0.29 else good

    return [step() for _ in range(150)]


@pytest.mark.parametrize("seed", range(40))
def test_a_session_made_by_chance_replays_the_same(tmp_path, seed):
    one = taped(with_limits(operator_timeout_s=1.0))
    lived(by_chance(one, seed), one)
    again = replayed(one.write(tmp_path / "a.tape"), with_limits(operator_timeout_s=1.0))
    assert again.difference is None
    assert again.frames == one.source.frames
    assert again.transitions, "it was armed now and then"


def test_the_second_session_has_no_commands_and_turns_nothing_on(busy, monkeypatch):
    _one, path = busy
    asked = []
    monkeypatch.setattr("tests.support.replay.scripted_tape.WatchedBeamLine.permit", lambda *_: asked.append("permit"))
    monkeypatch.setattr("tests.support.replay.scripted_tape.ScriptedSource.read", lambda *_: asked.append("read"))
    assert replayed(path).difference is None
    assert asked == []


@pytest.mark.parametrize(
    "changes",
    [{"dwell_ms": 150.0}, {"min_good_frames": 9}, {"lease_ms": 30.0}, {"max_gap_ms": 20.0}, {"min_fps": 60.0}],
    ids=str,
)
def test_another_limit_is_found(busy, changes):
    _one, path = busy
    again = replayed(path, with_limits(**changes))
    assert again.difference is not None
    assert again.difference.recorded != again.difference.replayed


def test_a_measurement_that_differs_in_the_last_bit_is_found_at_its_frame(busy):
    _one, path = busy
    a_bit_more = lambda one: replace(one, motion=replace(one.motion, volume_l=one.motion.volume_l + 1e-15))  # noqa: E731
    difference = replayed(path, spoil={12: a_bit_more}).difference
    assert (difference.frame, "volume_l" in difference.recorded) == (12, True)


def test_a_cell_that_no_table_reports_is_found_by_the_frames_digest(busy):
    _one, path = busy

    def a_bit_more(one):
        return replace(one, motion=replace(one.motion, regions_depth_mm=one.motion.regions_depth_mm + 1e-12))

    difference = replayed(path, spoil={12: a_bit_more}).difference
    assert (difference.frame, difference.recorded.split()[0]) == (12, "digest")


def test_a_session_that_was_stopped_stops_at_the_same_frame(tmp_path):
    one = taped()
    stop = after(one.loop._stop_requested.set)
    lived([good, after(lambda: one.loop.submit(ARM)), *(good for _ in range(8)), stop, *(good for _ in range(5))], one)
    again = replayed(one.write(tmp_path / "a.tape"))
    assert (again.difference, again.frames) == (None, one.source.frames)
    assert again.transitions[-1]["reason"] == "engine_stopped"


def test_a_camera_that_never_showed_anything_is_lost_again(tmp_path):
    one = lived([silent] * 300, taped())
    again = replayed(one.write(tmp_path / "a.tape"))
    assert again.difference is None
    assert (again.frames, again.transitions[-1]["reason"]) == (0, "source_lost")


def test_an_engine_that_asks_for_something_else_is_found(busy, monkeypatch):
    _one, path = busy
    unread = lambda _self, _queued: CommandInputs()  # noqa: E731
    monkeypatch.setattr("engine.control.turn_inputs.TurnReader.command", unread)
    difference = replayed(path).difference
    assert (difference.recorded, difference.replayed) == ("COMMAND observed", "CLOCK observed")


@pytest.mark.parametrize(
    ("error", "status"), [(SourceLostError("unplugged"), "source_lost"), (ValueError("a bug"), "engine_failed")]
)
def test_an_error_is_raised_again_in_the_same_words(tmp_path, error, status):
    one = taped()
    lived([good, after(lambda: one.loop.submit(ARM)), good, good, good, raising(error)], one)
    again = replayed(one.write(tmp_path / "a.tape"))
    assert again.difference is None
    assert again.transitions[-1]["reason"] == status


def test_a_line_that_fails_fails_again(tmp_path):
    one = taped()
    answers = iter([*(False for _ in range(60))])

    def is_on(_self=one.beam, usual=one.beam.is_on):
        if next(answers, None) is None:
            raise BeamLineError("no answer")
        return usual()

    one.beam.is_on = is_on
    lived([good, after(lambda: one.loop.submit(ARM)), *(good for _ in range(80))], one)
    again = replayed(one.write(tmp_path / "a.tape"))
    assert again.difference is None
    assert "beam_line_failed" in {row["reason"] for row in again.transitions}


def test_what_other_threads_ask_is_not_on_the_tape(tmp_path):
    one = taped()

    def read_elsewhere():
        reader = threading.Thread(target=lambda: [one.loop._clock.now_ns() for _ in range(50)])
        reader.start()
        reader.join()

    lived([good, after(read_elsewhere), good], one)
    path = one.write(tmp_path / "a.tape")
    readings = [kind for turn in read_tape(path).turns() for kind, _ in turn.observed if kind is InputKind.CLOCK]
    assert len(readings) < 40
    assert replayed(path).difference is None


def test_a_tape_without_a_writer_ends_where_its_queue_was_full_and_the_beam_stays_on(tmp_path):
    one = taped(turns_kept=20)
    lived([good, after(lambda: one.loop.submit(ARM)), *(good for _ in range(60))], one)
    assert "in time" in one.tap.torn
    assert one.beam.permits[-1].granted_ns > one.beam.permits[0].granted_ns
    assert len(one.beam.permits) > 50, "the beam was not held for it"
    again = replayed(one.write(tmp_path / "a.tape"))
    assert (again.difference, again.frames) == (None, 20)


def test_a_frame_that_could_not_be_kept_ends_the_tape_before_it(tmp_path):
    one = taped(keep_frame=lambda frame: "too slow" if frame.index == 7 else None)
    lived([good for _ in range(20)], one)
    again = replayed(one.write(tmp_path / "a.tape"))
    assert (one.tap.torn, again.difference, again.frames) == ("too slow", None, 7)


def test_a_tape_torn_anywhere_is_read_up_to_the_tear(busy, tmp_path):
    one, path = busy
    whole, torn = path.read_bytes(), tmp_path / "torn.tape"
    frames = []
    for length in range(200, len(whole), len(whole) // 40):
        torn.write_bytes(whole[:length])
        tape = read_tape(torn)
        frames.append(sum(len(turn.rows) > 0 for turn in tape.turns()))
        assert not tape.is_whole
    assert frames == sorted(frames)
    assert frames[-1] > one.source.frames * 0.8
    torn.write_bytes(whole[: len(whole) // 2])
    again = replayed(torn)
    assert (again.difference, again.frames > 10) == (None, True)


def test_a_tape_with_another_byte_in_it_is_damaged_or_differs(busy, tmp_path):
    _one, path = busy
    whole, spoilt = path.read_bytes(), tmp_path / "spoilt.tape"
    found = 0
    for place in range(150, len(whole) - 8, len(whole) // 25):
        spoilt.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            found += replayed(spoilt).difference is not None
        except RecordingError:
            found += 1
    assert found >= 24


def test_rows_are_lines_that_tell_a_bit_from_another():
    assert text_of({"a": 0.1 + 0.2}) != text_of({"a": 0.3})
    assert text_of({"a": float("nan")}) == text_of({"a": float("nan")})


def test_an_engine_that_asks_for_less_is_found(tmp_path):
    one = lived([good, good, good], taped())
    one.tap.turns.queue[1].observed.append((InputKind.WATCHDOG_RECORDED, False))
    difference = replayed(one.write(tmp_path / "a.tape")).difference
    assert (difference.recorded, difference.replayed) == ("WATCHDOG_RECORDED observed", "nothing more observed")


def test_what_was_written_is_there_for_who_kills_the_process(tmp_path):
    one = lived([good, good, good], taped())
    file = TapeFile(tmp_path / "a.tape", {}, NO_MODELS)
    for turns in (1, 2, 3):
        file.add(one.tap.turns.get())
        file.write()
        assert sum(1 for _ in read_tape(tmp_path / "a.tape").turns()) == turns
    file.end(None)
