"""`tidegate measure` of many recordings: a row each, a folder each, and what breaks breaks alone."""

import csv
import multiprocessing
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from engine.core.errors import InvalidValueError
from engine.motion.settings import PipelineSettings
from engine.offline import batch
from engine.offline.batch import FileOutcome, measure_files
from engine.offline.measure import FileTask
from engine.offline.result_files import OfflineSummary
from service.cli import app
from service.cli.measure.many import COLUMNS, summary_row
from service.cli.measure.options import MAX_JOBS, calibrations, check_jobs, folders

pytestmark = [pytest.mark.slow, pytest.mark.verification]

OUT = Path("out")


def names(*recordings):
    return [str(folder.relative_to(OUT)) for folder in folders([Path(name) for name in recordings], OUT)]


def test_each_recording_gets_a_folder_of_its_own_name():
    assert names("a/x.oni", "b/y.oni") == ["x", "y"]


def test_names_that_collide_take_their_folders_name_and_then_a_number():
    assert names("a/recording.oni", "b/recording.oni", "c.oni") == ["a-recording", "b-recording", "c"]
    assert names("1/a/rec.oni", "2/a/rec.oni") == ["a-rec", "a-rec-2"]
    assert names("a/rec.oni", "a/rec.oni", "a-rec.oni") == ["a-rec", "a-rec-2", "a-rec-3"]
    assert len({name.casefold() for name in names("a/Rec.oni", "b/rec.oni", "c/REC.oni")}) == 3
    assert names("A/rec.oni", "a/rec.oni") == ["A-rec", "a-rec-2"]


def test_no_folder_takes_the_summarys_name():
    assert names("summary.csv.oni", "b.oni") == ["summary.csv-2", "b"]


def test_one_calibration_is_for_all_several_are_for_each_and_none_is_the_one_beside_it():
    recordings = [Path("a/x.oni"), Path("b/y.oni")]
    one, two = Path("1.json"), Path("2.json")
    assert calibrations(recordings, [one]) == [one, one]
    assert calibrations(recordings, [one, two]) == [one, two]
    assert calibrations(recordings, []) == [Path("a/calibration.json"), Path("b/calibration.json")]
    with pytest.raises(InvalidValueError, match="once for each of the 2 recordings"):
        calibrations(recordings, [one, two, one])


def test_jobs_are_bounded_by_cores_files_and_sense():
    cores = len(os.sched_getaffinity(0))
    assert check_jobs(0, 1000) == min(cores, MAX_JOBS)
    assert check_jobs(5, 3) == 3
    assert check_jobs(2, 9) == 2
    for jobs in (-1, MAX_JOBS + 1):
        with pytest.raises(InvalidValueError, match="jobs"):
            check_jobs(jobs, 9)


def task(folder, name="recording.oni", settings=None):
    return FileTask(
        recording=folder / name,
        calibration=folder / "calibration.json",
        out=folder / f"out-{name}",
        settings=PipelineSettings() if settings is None else settings,
    )


def test_a_row_leaves_empty_what_was_not_measured(tmp_path):
    failed = summary_row(task(tmp_path), FileOutcome(summary=None, frames=0, seconds=0.0, error="broken"))
    assert tuple(failed) == COLUMNS
    assert failed["error"] == "broken"
    assert {failed[name] for name in ("measured", "cycles", "whole_pp_mm", "residual_max_mm", "seconds", "fps")} == {""}
    summary = OfflineSummary(
        frames=700, measured=400, lost=3, missed_frames=2, training_frames=200, cycles=3, whole_pp_mm=7.25
    )
    row = summary_row(task(tmp_path), FileOutcome(summary=summary, frames=700, seconds=2.0, error=None))
    assert (row["frames"], row["measured"], row["lost"], row["missed_frames"]) == ("700", "400", "3", "2")
    assert (row["whole_pp_mm"], row["residual_mean_mm"], row["fps"], row["error"]) == ("7.250", "", "350.0", "")


class Exits:
    """Settings that end the process which unpacks them."""

    def __reduce__(self):
        return os._exit, (3,)


class IsKilled:
    """Settings that kill the process which unpacks them, as a system out of memory would."""

    def __reduce__(self):
        return os.kill, (Kill(), signal.SIGKILL)


class Kill:
    def __reduce__(self):
        return os.getpid, ()


def test_a_process_that_dies_takes_no_other_along(tmp_path):
    (tmp_path / "junk.oni").write_text("no recording")
    tasks = [
        task(tmp_path, "a.oni", Exits()),
        task(tmp_path, "junk.oni"),
        task(tmp_path, "b.oni", IsKilled()),
        task(tmp_path, "absent.oni"),
    ]
    ended = []
    outcomes = measure_files(2, tasks, lambda *_: None, lambda position, _: ended.append(position))
    assert sorted(ended) == [0, 1, 2, 3]
    assert [outcome.summary for outcome in outcomes] == [None] * 4
    assert outcomes[0].error == "its process ended early (exit code 3)"
    assert "junk.oni" in outcomes[1].error
    assert outcomes[2].error == "its process ended early (signal 9)"
    assert "absent.oni" in outcomes[3].error


def test_an_interrupt_ends_the_processes_and_leaves_nothing_half_written(regular_volunteer, tmp_path):
    source = task(regular_volunteer)
    tasks = [
        FileTask(
            recording=source.recording, calibration=source.calibration, out=tmp_path / name, settings=source.settings
        )
        for name in ("a", "b")
    ]

    def interrupt(position, progress):
        if progress.frames > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure_files(2, tasks, interrupt, lambda *_: None)
    assert not multiprocessing.active_children()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(("is_single_pass", "total"), [(False, 40), (True, 20)])
def test_progress_counts_the_frames_of_all_passes(tmp_path, monkeypatch, is_single_pass, total):
    def measured(*_arguments, on_pass, on_frame, is_single_pass, **_options):
        for number in (1,) if is_single_pass else (1, 2):
            on_pass(number)
            for index in range(20):
                on_frame(SimpleNamespace(frame_index=index))
        return OfflineSummary(frames=20, measured=20, lost=0, missed_frames=0, training_frames=0, cycles=0)

    monkeypatch.setattr(batch, "measure_recording", measured)
    monkeypatch.setattr(batch, "describe", lambda _path: SimpleNamespace(depth_frames=20))
    monkeypatch.setattr(batch, "load_calibration", lambda _path: None)
    shown = []
    outcome = batch.measure_file(replace(task(tmp_path), is_single_pass=is_single_pass), shown.append)
    assert outcome.frames == 20
    assert [progress.frames for progress in shown] == list(range(0, total + 1, 10))
    assert {progress.total for progress in shown} == {total}


@pytest.fixture(scope="module")
def many(regular_volunteer, tmp_path_factory):
    """One run over a good recording, a cut one, one without a calibration and one that is none."""
    folder = tmp_path_factory.mktemp("many")
    whole = (regular_volunteer / "recording.oni").read_bytes()
    for name, content in (("cut", whole[: int(0.15 * len(whole))]), ("lone", whole[:1000]), ("junk", b"text")):
        (folder / name).mkdir()
        (folder / name / "recording.oni").write_bytes(content)
        if name != "lone":
            shutil.copy(regular_volunteer / "calibration.json", folder / name)
    recordings = [regular_volunteer, *(folder / name for name in ("cut", "lone", "junk"))]
    arguments = [str(path / "recording.oni") for path in recordings]
    result = CliRunner().invoke(app, ["measure", *arguments, "--out", str(folder / "out"), "--jobs", "2"])
    with (folder / "out" / "summary.csv").open() as file:
        return result, list(csv.DictReader(file)), folder / "out"


def test_every_recording_has_its_row_in_the_order_given(many):
    _, rows, _ = many
    assert [Path(row["folder"]).name for row in rows][1:] == ["cut-recording", "lone-recording", "junk-recording"]
    assert tuple(rows[0]) == COLUMNS
    good = rows[0]
    assert good["error"] == ""
    assert int(good["frames"]) == 719
    assert int(good["measured"]) + int(good["lost"]) == 719
    assert int(good["cycles"]) >= 3
    assert 3.0 < float(good["whole_pp_mm"]) < 30.0
    assert 0.0 < float(good["residual_mean_mm"]) < float(good["residual_max_mm"])
    assert float(good["recording_s"]) == pytest.approx(24.0, abs=0.1)
    assert float(good["fps"]) > 0.0
    assert sorted(path.name for path in Path(good["folder"]).iterdir()) == [
        *("breathing.csv", "model.npz", "motion.csv", "motion_summary.json", "regions.npz"),
    ]
    assert Path(good["calibration"]).name == "calibration.json"


def test_one_that_fails_does_not_stop_the_others_and_its_row_states_why(many):
    result, rows, _ = many
    assert result.exit_code == 2
    cut, lone, junk = rows[1:]
    assert "breathing cycles" in cut["error"]
    assert int(cut["frames"]) > 50
    assert cut["measured"] == cut["whole_pp_mm"] == ""
    assert "recording.oni" in junk["error"]
    assert lone["error"]


def test_the_table_on_the_terminal_has_a_line_for_each_and_no_traceback(many):
    result, rows, _ = many
    assert "Traceback" not in result.output
    assert "p-p mm" in result.output
    assert rows[0]["whole_pp_mm"] in result.output
    assert "breathing cycles" in " ".join(result.output.split())


def test_nothing_half_written_is_left(many):
    assert not list(many[2].rglob("*.partial"))
