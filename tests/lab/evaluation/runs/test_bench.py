"""Runs of the bench: made once, gone on with where they were, never half-written; and the oracle's place in them."""

import fcntl
import shutil

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from lab.evaluation.methods.outcome import Outcome
from lab.evaluation.runs.bench import do_run, is_measured, run_bench
from lab.evaluation.runs.datasets import (
    VOLUNTEERS,
    check_plan,
    full_plan,
    is_made,
    make_dataset,
    quick_plan,
    write_recipe,
)
from lab.evaluation.runs.marks import WHOLE_MM
from lab.evaluation.runs.scores import score_run
from lab.phantom.sensor import BENCHED, USUAL
from tests.support.evaluation.small_bench import SETTINGS, files_under, small_run, tiny_run

pytestmark = [pytest.mark.long, pytest.mark.slow]

RUN = small_run(is_pictured=True)
TINY = tiny_run()


def nothing(_progress):
    pass


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A work folder in which the small run is complete, and the run judged."""
    work = tmp_path_factory.mktemp("bench")
    (scored,) = run_bench([RUN], work, jobs=1, report=nothing, settings=SETTINGS)
    return work, scored


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A work folder in which the tiny run is complete."""
    work = tmp_path_factory.mktemp("tiny")
    do_run(TINY, work, SETTINGS, nothing)
    return work


@pytest.fixture
def work(tiny, tmp_path):
    """A copy of it that a test may spoil."""
    return shutil.copytree(tiny, tmp_path / "work")


class Witness:
    """Remembers what was done, and may refuse to go on."""

    def __init__(self, stop_at=None):
        self.done = []
        self._stop_at = stop_at

    def __call__(self, progress):
        self.done.append((progress.run, progress.doing))
        if progress.doing == self._stop_at:
            raise KeyboardInterrupt

    @property
    def doings(self):
        return {doing for _, doing in self.done}


def test_everybody_measures_the_same_frames_and_the_oracle_least_wrong(measured):
    _, scored = measured
    scores = scored.scores
    assert set(scores) == {"plain", "bilateral", "ours", "oracle"}
    assert len({scores[name].frames for name in ("plain", "ours", "oracle")}) == 1
    assert scores["oracle"].cells_mm < scores["ours"].cells_mm
    assert scores["oracle"].cells_mm < 0.6 * scores["plain"].cells_mm
    assert scores["bilateral"].cells_mm > scores["oracle"].cells_mm
    assert all(score.cells_mm < 1.5 for score in scores.values())


def test_laser_and_spirometer_stand_beside_a_dataset(measured):
    _, scored = measured
    assert np.isfinite(scored.outcome.instruments["laser_ours_mm"]).any()
    assert scored.outcome.notes["spirometer_lag_s"] is not None


def test_what_is_complete_is_not_done_again(measured):
    work, scored = measured
    witness = Witness()
    (again,) = run_bench([RUN], work, jobs=1, report=witness, settings=SETTINGS)
    assert witness.doings == {"done"}
    assert again.scores["ours"].cells_mm == scored.scores["ours"].cells_mm


def test_a_lost_measurement_is_measured_anew_from_the_same_recording(work):
    recording = work / TINY.name / "recording.oni"
    made_ns = recording.stat().st_mtime_ns
    (work / TINY.name / "measured.npz").unlink()
    witness = Witness()
    run_bench([TINY], work, jobs=1, report=witness, settings=SETTINGS)
    assert "making" not in witness.doings
    assert is_measured(TINY, work, SETTINGS)
    assert recording.stat().st_mtime_ns == made_ns


def test_other_settings_are_measured_anew(work):
    other = type(SETTINGS)(plain_frames=40, training=SETTINGS.training)
    assert is_measured(TINY, work, SETTINGS)
    assert not is_measured(TINY, work, other)


def test_another_seed_is_another_recording(work):
    folder = work / TINY.name
    assert is_made(folder, TINY.recipe)
    assert not is_made(folder, tiny_run(seed=6).recipe)


def test_a_recording_without_its_recipe_is_made_again(tmp_path):
    run = tiny_run()
    folder = tmp_path / run.name
    folder.mkdir()
    (folder / "recording.oni").write_bytes(b"half")
    make_dataset(run, folder, lambda _done, _all: None)
    assert (folder / "recording.oni").stat().st_size > 10_000
    assert is_made(folder, run.recipe)


@pytest.mark.parametrize("stop_at", ["making", "measuring"])
def test_an_interrupted_run_leaves_nothing_half_written(tmp_path, stop_at):
    run = tiny_run()
    with pytest.raises(KeyboardInterrupt):
        run_bench([run], tmp_path, jobs=1, report=Witness(stop_at), settings=SETTINGS)
    left = files_under(tmp_path)
    made = ["calibration.json", "flow.csv", "plane.json", "recipe.json", "recording.oni", "truth.npz"]
    expected = [] if stop_at == "making" else [run.name, *(f"{run.name}/{name}" for name in made)]
    assert left == [".lock", *expected]


def test_what_a_killed_process_left_is_cleared_away(tmp_path):
    (tmp_path / ".D01-4711").mkdir()
    (tmp_path / ".D01-4711" / "recording.oni").write_bytes(b"half")
    (tmp_path / "D07").mkdir()
    (tmp_path / "D07" / "measured.npz.partial").write_bytes(b"half")
    assert run_bench([], tmp_path, jobs=1, report=nothing, settings=SETTINGS) == []
    assert files_under(tmp_path) == [".lock", "D07"]


def test_two_processes_stop_in_order_and_then_finish_the_plan(tmp_path):
    plan = [tiny_run("D01"), tiny_run("D02", seed=6)]
    with pytest.raises(KeyboardInterrupt):
        run_bench(plan, tmp_path, jobs=2, report=Witness("making"), settings=SETTINGS)
    assert not [name for name in files_under(tmp_path) if name.endswith(".partial") or "-" in name]
    witness = Witness()
    scored = run_bench(plan, tmp_path, jobs=1, report=witness, settings=SETTINGS)
    assert [one.run.name for one in scored] == ["D01", "D02"]
    assert {name for name, doing in witness.done if doing == "done"} == {"D01", "D02"}


def test_two_benches_do_not_share_a_folder(tmp_path):
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InvalidValueError, match=r"work is .* no other evaluation"):
            run_bench([], tmp_path, jobs=1, report=nothing)


@pytest.mark.parametrize("jobs", [0, 65, True])
def test_an_impossible_number_of_processes_is_refused(tmp_path, jobs):
    with pytest.raises(InvalidValueError, match=r"jobs is .*: must be a whole number from 1 to 64"):
        run_bench([], tmp_path, jobs=jobs, report=nothing)


def test_a_recording_that_never_taught_anything_is_judged_all_the_same(tiny):
    scored = score_run(TINY, Outcome.load(tiny / TINY.name / "measured.npz"))
    assert scored.scores == {}


def test_a_recipe_is_of_what_it_names(tmp_path):
    write_recipe(tmp_path, {"a": 1}, "r.json")
    assert files_under(tmp_path) == ["r.json"]
    assert is_made(tmp_path, {"a": 1}, "r.json")
    assert not is_made(tmp_path, {"a": 2}, "r.json")


def test_the_fifteen_datasets_are_of_the_ten_volunteers_as_in_table_1():
    plan = [run for run in full_plan() if run.sensor == USUAL]
    fifteen = sorted((run for run in plan if run.group == "table2"), key=lambda run: run.name)
    assert [run.name for run in fifteen] == [f"D{number:02d}" for number in range(1, 16)]
    assert tuple(run.volunteer for run in fifteen) == VOLUNTEERS
    assert len({run.seed for run in fifteen}) == 15
    assert len({run.name for run in full_plan()}) == len(full_plan())


def test_both_sensors_record_each_kind_of_breathing_to_be_measured_whole():
    whole = [run for run in full_plan() if run.is_measured_whole]
    for sensor in BENCHED:
        assert {run.group for run in whole if run.sensor == sensor} == set(WHOLE_MM)


def test_quick_is_three_datasets_of_three_volunteers():
    plan = quick_plan()
    assert len(plan) == 3
    assert len({run.volunteer for run in plan}) == 3


def test_sweeps_cover_what_the_issue_asks_for():
    settings = {run.group: set() for run in full_plan() if run.is_sweep}
    for run in full_plan():
        if run.is_sweep:
            settings[run.group].add(run.setting)
    assert {600.0, 1200.0} <= settings["distance"]
    assert {2.0, 40.0} <= settings["amplitude"]
    assert settings["rate"] == {10.0, 15.0, 30.0}
    assert {0.0, 0.6} <= settings["holes"]


@pytest.mark.parametrize(("field", "seed", "seconds"), [("seed", -1, 32.0), ("seconds", 1, 5.0), ("seconds", 1, 1e9)])
def test_a_plan_out_of_bounds_is_refused_by_name(field, seed, seconds):
    with pytest.raises(InvalidValueError, match=rf"^{field} is "):
        check_plan(seed, seconds)


def test_the_couch_goes_down_under_a_patient_who_shifts_on_both_sensors():
    lowered = [run for run in full_plan() if run.is_lowered]
    assert {run.sensor for run in lowered} == set(BENCHED)
    for run in lowered:
        assert run.scenario == "shift"
        assert run.falsification.floor_stays
        assert [run.lowered_mm(time_s) for time_s in (0.0, 21.9, 33.0)] == [0.0, 0.0, 2.0]
    assert all(run.falsification is None and run.lowered_mm(33.0) == 0.0 for run in full_plan() if not run.is_lowered)
