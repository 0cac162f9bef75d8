"""The error budget: which recordings it measures, what it replaces by the truth, and that the errors follow."""

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.commands.evaluate.command import evaluate
from lab.evaluation.runs import budget
from lab.evaluation.runs.budget import PERFECT, RECORDED, ROWS, TRUE_MARKERS, Budget, runs, split, table
from lab.phantom.recording import load_truth

CELLS = (9, 35, 20)


def test_each_kind_of_breathing_is_measured_once_on_the_chosen_sensor_and_no_moved_couch():
    planned = runs(2017, "locking")
    assert sorted(run.scenario for run in planned) == ["dibh", "drift", "irregular", "isovolume", "regular", "shift"]
    assert {run.sensor for run in planned} == {"locking"}
    assert not any(run.is_lowered or run.has_laser for run in planned)
    for sensor in ("usual", "drawn-6"):
        assert [(run.scenario, run.sensor) for run in runs(2017, sensor, ("dibh",))] == [("dibh", sensor)]


def test_every_row_replaces_one_cause(tmp_path, monkeypatch):
    made, measured = {}, []
    monkeypatch.setattr(budget, "make_dataset", lambda run, folder, _: made.__setitem__(folder.name, run.sensor))
    monkeypatch.setattr(budget, "load_truth", lambda path: path.parent.name)
    monkeypatch.setattr(budget, "_errors_mm", lambda folder, model: measured.append((folder.name, model)) or (1, 1, 1))
    counted = []
    found = split(runs(2017, "locking", ("regular",))[0], tmp_path, counted.append)
    assert len(found.errors_mm) == len(measured) == len(ROWS) == counted[-1]
    assert made[RECORDED] == "locking"
    assert made["no steps"] == "locking without steps"
    assert made[PERFECT] == "locking without noise, pattern, locking, steps"
    assert measured[-3:] == [
        (RECORDED, tmp_path / PERFECT / "model.npz"),
        (PERFECT, tmp_path / RECORDED / "model.npz"),
        (RECORDED, None),
    ]


def test_the_markers_are_put_where_they_are(regular_volunteer):
    whole = budget._errors_mm(regular_volunteer, None)
    with budget._true_markers(load_truth(regular_volunteer / "truth.npz")):
        placed = budget._errors_mm(regular_volunteer, None)
    assert whole[0] > whole[1] > whole[2] > 0.01
    assert placed != whole
    assert placed == pytest.approx(whole, rel=0.3)  # markers are found to some hundredths of a pixel


def test_the_table_has_a_row_a_cause_and_three_columns_a_recording():
    chosen = runs(2017, "locking")[:2]
    numbers = np.arange(3.0 * len(ROWS)).reshape(-1, 3)
    found = table([Budget(run=run, errors_mm=tuple(map(tuple, numbers + 100 * i))) for i, run in enumerate(chosen)])
    assert len(found.columns) == 7
    assert found.rows[0] == (RECORDED, 0.0, 1.0, 2.0, 100.0, 101.0, 102.0)
    assert found.rows[-1][0] == TRUE_MARKERS


@pytest.mark.parametrize(
    ("command", "arguments", "field"),
    [
        ("budget", ["--sensor", "lidar"], "sensor is 'lidar'"),
        ("budget", ["--scenario", "regular", "--scenario", "cough"], "scenario is 'cough'"),
        ("budget", ["--seed", "-1"], "seed is -1"),
        ("ablations", ["--scenario", "cough"], "scenario is 'cough'"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, command, arguments, field):
    result = CliRunner().invoke(evaluate, [command, "--out", str(tmp_path / "out"), *arguments])
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert result.stderr.startswith(f"tidegate evaluate {command}: {field}")
    assert not (tmp_path / "out").exists()
