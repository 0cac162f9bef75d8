"""The bench of speed: its arithmetic by hand, and all of it once, small, for real."""

import json
import math
import os
import signal
import tempfile
from dataclasses import asdict, replace

import numpy as np
import pytest
from typer.testing import CliRunner

import lab.commands.bench as bench_command
from engine.capture.oni.reader import OniReader, describe
from engine.core.clock import ManualClock
from engine.core.errors import SourceEndedError
from engine.core.gate_state import GateState
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from lab.performance import frames as frames_module, session as recording_module
from lab.performance.bench import full_sizes, write_figures
from lab.performance.frames import FrameSizes, calls_a_frame, time_frames
from lab.performance.machine import SpeedBenchError, frames_per_s, heap_in_use_bytes, on_cores, pinned, timing_of
from lab.performance.memory import MemorySizes, memory_use
from lab.performance.results import reach, speed_tables
from lab.performance.session import BenchSession, EndlessSource, Recording, make_recording
from service.cli import app
from tests.support.evaluation.performance_figures import FRAMES, GOOD, TINY, slower, took

pytestmark = [pytest.mark.long, pytest.mark.slow]

US = 1000.0
MB = 1_000_000
MOST_CALLS = 360.0
HURRIED = TrainingSettings(min_frames=40, min_cycles=0, min_seconds=3.0, max_seconds=6.0, max_frames=200)


def lit(folder):
    """Return the shared volunteer, learned from in a hurry."""
    with OniReader(folder / "recording.oni") as reader:
        return Recording(folder=folder, fps=float(reader.depth.fps), training=HURRIED)


# -- arithmetic ---------------------------------------------------------------------------------------------------


def test_a_disturbed_block_moves_neither_median_nor_p99_but_shows_in_the_tail():
    quiet, disturbed = np.arange(1.0, 101.0) ** 2 * US, np.full(100, 50_000.0 * US)
    timing = timing_of([quiet, disturbed, quiet])
    assert timing.median_us == pytest.approx((50.0**2 + 51.0**2) / 2.0)
    assert timing.p99_us == pytest.approx(99.0**2 + 0.01 * (100.0**2 - 99.0**2))
    assert (timing.max_us, timing.samples, timing.blocks) == (50_000.0, 300, 3)
    assert timing.p999_us == pytest.approx(50_000.0)


def test_nothing_timed_is_not_a_number_rather_than_fast():
    timing = timing_of([np.empty(0)])
    assert timing.samples == timing.blocks == 0
    assert np.isnan([timing.median_us, timing.p99_us, timing.p999_us, timing.max_us]).all()


def test_a_rate_counts_the_steps_between_stamps():
    assert frames_per_s(np.array([0.0, 0.5e9, 1.0e9])) == pytest.approx(2.0)
    assert np.isnan(frames_per_s(np.array([1.0])))


@pytest.mark.parametrize(("leak_mb_s", "growth_mb"), [(0.0, 0.0), (0.5, 10.0)], ids=["flat", "leaking"])
def test_memory_grows_by_what_was_leaked_between_the_two_moments(leak_mb_s, growth_mb):
    resident = [round((200.0 + leak_mb_s * second) * MB) for second in range(40)]
    sizes = MemorySizes(session_s=40.0, warm_s=20.0, retrain_s=10.0)
    use = memory_use(resident, resident, sizes, frames=480, models=2)
    assert use.growth_mb == pytest.approx(growth_mb)
    assert use.peak_end_mb == pytest.approx(200.0 + 39.0 * leak_mb_s)
    assert use.used_end_mb - use.used_start_mb == pytest.approx(growth_mb)


def test_scratch_that_comes_and_goes_is_no_growth():
    resident = [200 * MB] * 40
    resident[18] = resident[38] = 290 * MB
    use = memory_use(
        resident, [150 * MB] * 40, MemorySizes(session_s=40.0, warm_s=20.0, retrain_s=10.0), frames=480, models=2
    )
    assert use.growth_mb == 0.0
    assert (use.peak_start_mb, use.peak_end_mb) == (290.0, 290.0)
    assert (use.used_start_mb, use.used_end_mb) == (150.0, 150.0)


@pytest.mark.parametrize("first", range(15))
def test_frames_that_are_collected_and_released_are_no_growth_at_any_phase(first):
    resident = [(200 + 3 * ((first + second) % 15)) * MB for second in range(40)]
    sizes = MemorySizes(session_s=40.0, warm_s=20.0, retrain_s=10.0)
    use = memory_use(resident, resident, sizes, frames=480, models=2)
    assert (use.start_mb, use.end_mb) == (200.0, 200.0)
    assert use.used_end_mb == use.used_start_mb


def rises_and_falls_bytes(held_bytes):
    before = heap_in_use_bytes()
    held = np.ones(held_bytes, dtype=np.uint8)
    risen = heap_in_use_bytes() - before
    del held
    return risen, heap_in_use_bytes() - before


def test_heap_in_use_rises_by_what_is_held_and_falls_when_it_is_let_go():
    risen, left = on_cores(sorted(os.sched_getaffinity(0)), rises_and_falls_bytes, 40 * MB)
    assert risen == pytest.approx(40 * MB, rel=0.05)
    assert left == pytest.approx(0.0, abs=2 * MB)


def test_a_session_shorter_than_its_warm_up_states_nothing_of_memory():
    with pytest.raises(SpeedBenchError, match="20 s is shorter than its warm-up of 20 s"):
        memory_use(
            [200 * MB] * 20,
            [200 * MB] * 20,
            MemorySizes(session_s=20.0, warm_s=20.0, retrain_s=10.0),
            frames=240,
            models=1,
        )


# -- the long session -----------------------------------------------------------------------------------------------


def test_a_recording_begins_again_while_numbers_and_times_go_on(lit_volunteer):
    recording = lit(lit_volunteer)
    in_file = describe(recording.path).depth_frames
    source = EndlessSource(recording, most_frames=in_file + 3)
    source.open()
    frames = [source.read(1.0) for _ in range(in_file + 3)]
    with pytest.raises(SourceEndedError, match=f"{in_file + 3}"):
        source.read(1.0)
    source.close()
    assert [frame.index for frame in frames] == list(range(in_file + 3))
    assert {frame.missed_frames for frame in frames} == {0}
    steps_us = np.diff([frame.timestamp_us for frame in frames])
    assert 0.9e6 / recording.fps < steps_us.min() <= steps_us.max() < 1.1e6 / recording.fps
    assert [frame.pair_gap_us for frame in frames[in_file:]] == [frame.pair_gap_us for frame in frames[:3]]
    assert np.array_equal(frames[in_file].depth_mm, frames[0].depth_mm)


def test_frames_pictures_and_the_plain_method_are_timed(lit_volunteer):
    costs = time_frames(
        lit(lit_volunteer),
        FrameSizes(blocks=1, block_frames=20, plain_frames=2, decoded=3, peer_frames=1),
        switch_interval_s=0.005,
    )
    assert (costs.whole.samples, costs.plain.samples, costs.peer.samples) == (20, 2, 1)
    assert [picture.timing.samples for picture in costs.decoding] == [3, 3]


class TickingClock(ManualClock):
    """Goes on by ten milliseconds whenever it is read."""

    def now_ns(self):
        self.advance_ns(10_000_000)
        return super().now_ns()


def test_a_measured_frame_makes_so_many_calls_of_python_and_no_more(lit_volunteer):
    """A count is no time: it is the same on every processor. The target is 250.

    Of frames with the beam on, soon after the first model, when frames are still kept for a refit.
    """
    session = BenchSession(lit(lit_volunteer), InlineTrainer())
    session.learn()
    calls = calls_a_frame(session, 20)
    session.close()
    assert 100.0 < calls <= MOST_CALLS


def test_calls_of_frames_without_beam_are_not_counted(lit_volunteer, monkeypatch):
    monkeypatch.setattr(frames_module, "MOST_UNTIL_ON", 0)
    session = BenchSession(lit(lit_volunteer), InlineTrainer())
    assert math.isnan(calls_a_frame(session, 3))
    session.close()


def test_frames_are_decided_on_with_the_beam_on_though_learning_made_one_too_old(lit_volunteer):
    clock = TickingClock()

    class SlowTrainer(InlineTrainer):
        def start(self, job):
            clock.advance_ns(2_000_000_000)
            super().start(job)

    session = BenchSession(lit(lit_volunteer), SlowTrainer(), clock=clock)
    session.learn()
    for _ in range(12):
        session.decide(session.read())
    session.close()
    assert session.gate.state is GateState.BEAM_ON


# -- processes on cores ---------------------------------------------------------------------------------------------


def test_work_runs_on_the_cores_it_was_given_and_the_caller_keeps_its_own():
    mine = os.sched_getaffinity(0)
    core = max(mine)
    assert on_cores((core,), os.sched_getaffinity, 0) == {core}
    assert os.sched_getaffinity(0) == mine
    with pytest.raises(ZeroDivisionError), pinned((core,)):
        raise ZeroDivisionError
    assert os.sched_getaffinity(0) == mine


def test_what_a_process_cannot_do_is_reported_in_its_words(tmp_path):
    missing = Recording(folder=tmp_path, training=HURRIED)
    cores = tuple(os.sched_getaffinity(0))
    with pytest.raises(SpeedBenchError, match=r"calibration\.json.*No such file"):
        on_cores(cores, time_frames, missing, TINY.frames, 0.005)


def test_a_process_that_dies_is_an_error_not_a_wait():
    with pytest.raises(SpeedBenchError, match="exit code 7"):
        on_cores(tuple(os.sched_getaffinity(0)), os._exit, 7)


# -- marks and tables -----------------------------------------------------------------------------------------------


def test_a_machine_that_is_fast_enough_reaches_every_mark():
    marks = reach(GOOD)
    assert len(marks) == 10
    assert all(mark.is_met for mark in marks)


@pytest.mark.parametrize(
    ("figures", "missed"),
    [
        (slower(to_gate=took(400.0, p99_us=801.0)), "frame to gate, p99 over median"),
        (slower(calls=251.0), "Python calls a frame"),
        (slower(calls=float("nan")), "Python calls a frame"),
        (slower(plain=took(16_000.0), whole=took(534.0)), "plain method over ours, medians"),
        (replace(GOOD, fit=replace(GOOD.fit, fit_s=0.31)), "fit of 450 frames"),
        (
            replace(GOOD, while_fitting=(replace(GOOD.while_fitting[0], timing=took(500.0, p99_us=2251.0)),)),
            "frame to gate while fitting, p99 over quiet, one core",
        ),
        (
            replace(GOOD, throughput=(replace(GOOD.throughput[0], frames=999), GOOD.throughput[1])),
            "tidegate measure over the plain method, one core",
        ),
        (
            replace(GOOD, throughput=(GOOD.throughput[0], replace(GOOD.throughput[1], frames=812))),
            "tidegate measure over the plain method, two cores",
        ),
        (
            slower(decoding=(replace(FRAMES.decoding[0], timing=took(351.0)), FRAMES.decoding[1])),
            "decode depth, 16zT",
        ),
        (replace(GOOD, memory=replace(GOOD.memory, end_mb=208.1)), "memory growth over 2 min"),
        (replace(GOOD, memory=replace(GOOD.memory, end_mb=float("nan"))), "memory growth over 2 min"),
    ],
    ids=[
        "spread",
        "calls",
        "calls-not-a-number",
        "ratio",
        "fit",
        "while-fitting",
        "measure",
        "measure-2",
        "decoding",
        "memory",
        "not-a-number",
    ],
)
def test_each_mark_is_missed_by_its_own_figure_and_no_other(figures, missed):
    assert [mark.name for mark in reach(figures) if not mark.is_met] == [missed]


def test_tables_say_what_the_figures_say():
    times, others, marks = speed_tables(GOOD, reach(GOOD))
    assert times.rows[0] == ("frame to gate", 400.0, 800.0, 2400.0, 3200.0, 1000)
    frame, decoding, fitting = (
        [410.0, 390.0, 1170.0, 16_000.0, 200_000.0],
        [300.0, 900.0, 2000.0, 2000.0],
        [480.0, 500.0, 440.0, 450.0],
    )
    assert [row[1] for row in times.rows[1:]] == frame + decoding + fitting
    for said in ("39.0 times faster than the plain", "3.00 times faster than the numpy", "25.0%"):
        assert said in times.note
    values = [row[1] for row in others.rows]
    assert values == [
        0.2,
        1.0,
        1.5,
        1.1,
        600.0,
        520.0,
        750.0,
        1200.0,
        750.0,
        800.0,
        200.0,
        300.0,
        100.0,
        201.0,
        240.0,
        100.5,
    ]
    assert [row[4] for row in marks.rows] == ["met"] * 10
    assert all(len(row) == len(table.columns) for table in (times, others, marks) for row in table.rows)


def test_the_json_holds_everything_and_null_for_what_is_not_a_number(tmp_path):
    figures = slower(plain=took(float("nan")))
    path = write_figures(figures, reach(figures), tmp_path / "out", command="tidegate bench")
    content = json.loads(path.read_text())
    assert content["schema"] == "tidegate.speed/1"
    assert set(asdict(figures)) < set(content)
    assert content["frames"]["plain"]["median_us"] is None
    assert content["ratio"] == {"median": None, "p99": None}
    assert content["machine"]["opencv"] == "5.0.0"
    unmet = [mark["name"] for mark in content["marks"] if not mark["is_met"]]
    assert [name for name in unmet if "plain method" not in name] == []
    assert len(unmet) == 3
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["bench.json"]


# -- the recording and the command ----------------------------------------------------------------------------------


def test_a_complete_recording_is_used_again_and_any_other_made_anew(tmp_path, monkeypatch):
    made = []

    def make(scenario, **wanted):
        made.append((scenario, wanted["volunteer"], wanted["seconds"], wanted["fps"], wanted["seed"]))
        wanted["out"].mkdir()

    monkeypatch.setattr(recording_module, "make_volunteer", make)
    folder = make_recording(tmp_path, 40.0, lambda _done, _total: None)
    assert make_recording(tmp_path, 40.0, lambda _done, _total: None) == folder
    assert made == [("regular", 1, 40.0, 30.0, 1)]
    make_recording(tmp_path, 24.0, lambda _done, _total: None)
    (folder / "recipe.json").unlink()
    make_recording(tmp_path, 24.0, lambda _done, _total: None)
    assert [seconds for _, _, seconds, *_ in made] == [40.0, 24.0, 24.0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--memory-minutes", "1"], "memory_minutes is 1.0: must be a number from 2 to 600"),
        (["--memory-minutes", "nan"], "memory_minutes is nan"),
        (["--work", __file__], "work is"),
        (["--out", __file__], "out is"),
    ],
    ids=["short", "nan", "work", "out"],
)
def test_bad_options_are_refused_in_one_line(options, said):
    result = CliRunner().invoke(app, ["bench", *options])
    assert result.exit_code == 2
    assert said in result.output
    assert len(result.output.strip().splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=str)
def test_on_sigterm_it_leaves_no_temporary_folder_and_reports_it_in_one_line(number, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    seen = []

    def asked_to_end(work, _seconds, _tell):
        seen.append(work.parent)
        signal.raise_signal(number)

    monkeypatch.setattr(bench_command, "make_recording", asked_to_end)
    before = signal.getsignal(signal.SIGTERM)
    # Started in the background, as a test run may be, Python leaves Ctrl-C ignored.
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)
    result = CliRunner().invoke(app, ["bench"])
    signal.signal(signal.SIGINT, interrupt)
    assert (result.exit_code, result.output) == (130, "tidegate bench: stopped\n")
    assert seen == [tmp_path]
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_hour_is_what_sixty_minutes_are():
    assert full_sizes(60.0).memory.session_s == 3600.0


def test_a_command_that_fails_is_reported_in_its_last_line(tmp_path):
    with pytest.raises(SpeedBenchError, match=r"tidegate measure failed: .*missing\.oni: cannot be opened"):
        bench_command.run_measure([tmp_path / "missing.oni"], tmp_path / "out", tuple(os.sched_getaffinity(0)), 1)


def test_others_load_is_named_beside_the_figures(capsys):
    busy = replace(GOOD, machine=replace(GOOD.machine, load_average=3.5))
    bench_command.show(GOOD, reach(GOOD))
    assert "Note" not in capsys.readouterr().err
    bench_command.show(busy, reach(busy))
    said = capsys.readouterr()
    assert "load average was 3.5" in said.err
    assert f"All {len(reach(busy))} required values met" in said.err


def test_the_whole_bench_runs_from_the_command_line(lit_volunteer, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_command, "make_recording", lambda _work, _seconds, _tell: lit_volunteer)
    monkeypatch.setattr(bench_command, "quick_sizes", lambda _minutes: TINY)
    work = tmp_path / "work"
    result = CliRunner().invoke(app, ["bench", "--quick", "--work", str(work), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    for title in (
        "Times of a frame",
        "Learning, recordings from disk, memory",
        "Performance targets",
    ):
        assert title in result.output
    content = json.loads((tmp_path / "out" / "bench.json").read_text())
    frames = describe(lit_volunteer / "recording.oni").depth_frames
    assert [run["frames"] for run in content["throughput"]] == [frames, frames, 2 * frames]
    assert [beside["cores"] for beside in content["while_fitting"]] == [1, 2]
    assert all(beside["timing"]["samples"] > 0 for beside in content["while_fitting"])
    assert content["memory"]["frames"] == 420
    assert content["memory"]["models"] >= 1
    assert content["command"] == "tidegate bench --quick --memory-minutes 2"
    assert list(work.iterdir()) == []
