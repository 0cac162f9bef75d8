"""The load on a real service, small: what is counted, never how long anything took."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from engine.capture.oni.reader import OniReader
from engine.capture.recording_source import OniFileSource
from engine.core.clock import MonotonicClock
from engine.motion.tracking.repeated_pictures import RepeatedPictures
from tests.support.site_settings import give_settings
from verification.load.callers import MIX
from verification.load.figures import figures_of, marks_of
from verification.load.frames import Block, times_in
from verification.load.interruption import Ending
from verification.load.message_heads import read_head
from verification.load.recording import FPS, write_long
from verification.load.run import Counted, Load, Outcome, run
from verification.load.table import text_of
from verification.load.usage import usage_of

pytestmark = pytest.mark.waiting

SMALL = Load(dashboards=5, events=1, stalled=1, requests_per_s=20.0, rounds=1, quiet_s=1.0, loaded_s=4.0)
LEAST_TO_LEARN_FROM = {"training_min_frames": 60, "training_min_cycles": 1, "training_min_seconds": 4}
MS = 1_000_000


@pytest.fixture(scope="module")
def quickly_learned(
    regular_volunteer: Path, monkeypatch_module: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    monkeypatch_module.setattr("verification.load.run.base_folder", lambda: regular_volunteer)
    give_settings(monkeypatch_module, tmp_path_factory.mktemp("config"), **LEAST_TO_LEARN_FROM)


@pytest.fixture(scope="module")
def found(quickly_learned: None) -> dict:
    return figures_of(run(SMALL))


@pytest.fixture(scope="module")
def monkeypatch_module():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


def test_no_frame_is_lost_and_all_frames_are_counted(found):
    frames = found["frames"]["all"]
    assert frames["absent"] == frames["missed"] == 0
    assert frames["count"] > FPS * (SMALL.quiet_s + SMALL.loaded_s) / 2


def test_every_client_that_reads_gets_samples_in_their_order_and_stays(found):
    clients = found["clients"]
    assert (clients["healthy"], clients["stalled"]) == (4, 1)
    assert clients["samples_per_s_least"] > 0
    assert clients["backwards"] == clients["closed"] == 0
    # A connection's losses were reported: numbers go on without a gap, or the gap has its message.
    assert clients["lost_to_gaps"] <= clients["skipped_reported"]


def test_every_kind_of_request_is_answered(found):
    answered = {name.rpartition(" ")[0] for name, count in found["answers"].items() if name.endswith(" 200")}
    assert {f"{method} {path}" for method, path in MIX} <= answered
    assert "export" in answered
    assert not found["requests"]["failures"]
    assert not [name for name in found["answers"] if not name.endswith((" 200", " 204"))]


def test_a_run_that_is_asked_to_end_reports_what_it_has(quickly_learned):
    ending, steps, last = Ending(), [], "round 2 of 2: quiet"

    def on_step(step: str) -> None:
        steps.append(step)
        if step == last:
            ending.handle()

    outcome = run(replace(SMALL, rounds=2, loaded_s=2.0), on_step, ending)
    assert steps[-2:] == [last, "closing the session"]
    assert (len(outcome.quiet.blocks), len(outcome.loaded.blocks)) == (2, 1)
    figures = figures_of(outcome)
    assert figures["session"]["status"] == "stopped"
    assert figures["requests"]["all"]
    assert text_of(figures).startswith("Ended early, as asked")


def test_what_was_found_is_reported_as_text(found):
    text = text_of(found)
    assert "received to decided" in text
    assert "frames lost | 0 | none | yes" in text


QUIET = {"decision_p50_ms": 1.0, "decision_p99_ms": 2.0, "decision_p999_ms": 4.0}
LOADED = {"decision_p99_ms": 3.0, "decision_p999_ms": 10.0}


@pytest.mark.parametrize(
    ("part", "changed", "missed"),
    [
        ("loaded", {"decision_p99_ms": 10.1}, {"received to decided, p99", "received to decided, p99 over quiet"}),
        ("loaded", {"decision_p99_ms": 3.1}, {"received to decided, p99 over quiet"}),
        ("loaded", {"decision_p999_ms": 10.1}, {"received to decided, p999 over quiet"}),
        ("quiet", {"decision_p50_ms": 1.6}, {"received to decided, quiet, p50"}),
        ("quiet", {"decision_p99_ms": 3.1}, {"received to decided, quiet, p99"}),
        ("memory", {"idle_mb": 200.1}, {"memory, idle"}),
        ("memory", {"start_mb": 350.1}, {"memory, armed"}),
        ("memory", {"seconds": 600.0, "end_mb": 307.0}, {"memory grown since the first minute"}),
        ("ready", 1.6, {"the service answers"}),
        ("session", {"beam_on": 300, "hold": 2000, "fault": 1}, {"frames in a fault"}),
        ("session", {"beam_on": 299, "hold": 2701}, {"frames without beam on"}),
    ],
)
def test_a_missed_mark_is_reported(found, part, changed, missed):
    """Beside figures that reach every one of these marks."""
    frames = {**found["frames"], "quiet": {**found["frames"]["quiet"], **QUIET}}
    frames["loaded"] = {**found["frames"]["loaded"], **LOADED}
    memory = {**found["memory"], "seconds": 60.0, "idle_mb": 200.0, "start_mb": 350.0, "warm_mb": 300.0}
    good = {**found, "frames": frames, "memory": memory, "ready_s": 1.5}
    good["session"] = {**found["session"], "gate": {"beam_on": 300, "hold": 2700}}
    if part == "ready":
        bad = {**good, "ready_s": changed}
    elif part == "session":
        bad = {**good, part: {**good[part], "gate": changed}}
    elif part == "memory":
        bad = {**good, "memory": {**memory, **changed}}
    else:
        bad = {**good, "frames": {**frames, part: {**frames[part], **changed}}}
    assert {mark["name"] for mark in marks_of(bad) if not mark["is_met"]} - {
        mark["name"] for mark in marks_of(good) if not mark["is_met"]
    } == missed


def test_a_long_recording_has_no_seam_and_no_picture_of_a_frozen_camera(regular_volunteer, tmp_path):
    """A picture backwards is another than the one forwards: at the turn both are in the last three seconds."""
    base, out = regular_volunteer / "recording.oni", tmp_path / "long.oni"
    seconds = 2.0 * depth_us(base).size / FPS - 1.0
    assert write_long(base, seconds, out) == depth_us(out).size >= seconds * FPS
    assert abs(np.diff(depth_us(out)) - 1e6 / FPS).max() < 3000
    watch, turn = RepeatedPictures(), depth_us(base).size + 90
    source = OniFileSource(out, clock=MonotonicClock())
    source.open()
    for number in range(turn):
        assert watch.check(source.read(timeout_s=1.0)) is None, f"frame {number} of {turn}"
    source.close()


def depth_us(recording):
    with OniReader(recording) as reader:
        return np.array([frame.timestamp_us for frame in reader.frames(with_payload=False) if frame.is_depth])


def test_frames_are_counted_in_the_block_they_came_in_and_those_that_are_missing_are():
    table = session(
        received_ms=[0, 33, 66, 133, 166, 200], decided_after_ms=[1, 1, 2, 40, 3, 1], index=[0, 1, 2, 4, 5, 6]
    )
    times = times_in(table, [Block(kind="loaded", begin_s=0.05, end_s=0.19)])
    assert times.decision_ms.tolist() == [2.0, 40.0, 3.0]
    assert (times.count, times.absent, times.over) == (3, 1, 1)
    table = session(received_ms=[0, 66, 100], decided_after_ms=[1, 1, 1], index=[0, 2, 3])
    assert times_in(table, [Block(kind="loaded", begin_s=0.05, end_s=0.2)]).absent == 1, "at the edge"


def test_a_frame_that_is_read_late_is_counted():
    table = session(received_ms=[0, 33, 120], decided_after_ms=[1, 1, 1], index=[0, 1, 2], due_ms=[10, 43, 76])
    assert times_in(table, [Block(kind="all", begin_s=0.0, end_s=1.0)]).come_late == 1


def test_a_run_that_was_ended_before_any_load_has_figures_without_it():
    frames = session(received_ms=[0, 33, 66], decided_after_ms=[1, 1, 2], index=[0, 1, 2])
    frames = frames.append_column("gate", pa.array(["hold"] * 3)).append_column("hold_reason", pa.array([None] * 3))
    quiet = Counted(blocks=[Block(kind="quiet", begin_s=0.0, end_s=0.1)])
    outcome = Outcome(
        load=SMALL,
        frames=frames,
        session={"status": "stopped"},
        transitions=0,
        quiet=quiet,
        loaded=Counted(),
        begun_s=0.0,
        ended_s=0.1,
        ready_s=1.0,
        idle=usage_of(os.getpid()),
        memory=[usage_of(os.getpid())],
        answers={},
        load_averages=(0.0, 0.0),
        log="",
        is_cut_short=True,
    )
    found = figures_of(outcome)
    assert found["frames"]["quiet"]["decision_max_ms"] == 2.0
    assert "0 s of load" in text_of(found)
    decided = [mark for mark in found["marks"] if mark["name"].startswith("received to decided")]
    assert {mark["name"] for mark in decided if mark["is_met"]} == {
        f"received to decided, quiet, p{n}" for n in (50, 99)
    }


@pytest.mark.parametrize("blank", ["", " "])
def test_the_head_of_a_message_is_read_without_the_rest(blank):
    text = (
        f'{{"type":{blank}"sample","sequence":{blank}17,"sent_at":{blank}"2026-11-21T03:00:00.123Z",'
        f'"age_ms":{blank}4.1,"session_id":"x","frame_index":{blank}512,"timestamp_us":1, and then no JSON at all'
    )
    head = read_head(text.encode())
    assert (head.kind, head.sequence, head.frame_index) == ("sample", 17, 512)
    assert head.made_s == pytest.approx(1795230000.1189, rel=0.0, abs=1e-4)


def session(
    *, received_ms: list[int], decided_after_ms: list[int], index: list[int], due_ms: list[int] | None = None
) -> pa.Table:
    received = np.array(received_ms) * MS
    decided = received + np.array(decided_after_ms) * MS
    return pa.table(
        {
            "frame_index": np.array(index),
            "timestamp_us": np.array(due_ms or received_ms) * 1000,
            "missed_frames": np.zeros(len(index), int),
            "captured_ns": pa.array([None, *received[1:].tolist()], pa.int64()),
            "received_ns": received,
            "decided_ns": decided,
            "asserted_ns": decided,
        }
    )


def test_a_load_states_how_long_its_recording_has_to_be():
    assert replace(SMALL, rounds=3).seconds - SMALL.seconds == pytest.approx(2 * (5.0 + 40.0))
