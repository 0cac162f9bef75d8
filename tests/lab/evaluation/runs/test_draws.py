"""Drawn sensors: which recordings are measured, that the curve is left on once, and what the table says of them."""

import pytest
from typer.testing import CliRunner

from engine.motion.learning import fitting
from lab.commands.evaluate.command import evaluate
from lab.evaluation.runs import draws
from lab.evaluation.runs.draws import DrawnErrors, measure, runs, table


def test_each_draw_has_each_kind_of_breathing_once_on_a_sensor_of_its_own():
    planned = runs(2017, 3, 2, ("regular", "isovolume"))
    assert [(run.sensor, run.scenario) for run in planned] == [
        (f"drawn-{number}", scenario) for number in (3, 4) for scenario in ("regular", "isovolume")
    ]
    assert len({run.name for run in planned}) == 4
    assert not any(run.has_instruments for run in planned)


def test_a_recording_is_measured_with_the_curve_left_on_then_taken_off(tmp_path, monkeypatch):
    found = []
    monkeypatch.setattr(draws, "make_dataset", lambda *_: None)
    monkeypatch.setattr(
        draws, "_errors", lambda _folder: found.append(fitting.find_locking) or (float(len(found)),) * 3
    )
    one = measure(runs(2017, 0, 1, ("regular",))[0], tmp_path)
    assert (one.left_on[0], one.taken_off[0]) == (1.0, 2.0)
    assert found[0] is not found[1] is fitting.find_locking
    assert found[0]() is None


def test_the_table_ends_each_kind_of_breathing_with_its_mean_and_its_worst():
    found = [
        DrawnErrors(run=run, left_on=(0.2 + at, 0.1, 0.05), taken_off=(0.1, 0.05, 0.02 + at))
        for at, run in enumerate(runs(2017, 0, 2, ("regular",)))
    ]
    made = table(found)
    assert [row[0] for row in made.rows] == ["drawn-0", "drawn-1", "mean", "worst"]
    assert made.rows[2][2:] == pytest.approx((0.7, 0.1, 0.05, 0.1, 0.05, 0.52))
    assert made.rows[3][2:] == pytest.approx((1.2, 0.1, 0.05, 0.1, 0.05, 1.02))


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--draws", "0"], "draws is 0"),
        (["--first", "-1"], "first is -1"),
        (["--first", "995", "--draws", "6"], "first is 995"),
        (["--scenario", "yoga"], "scenario is 'yoga'"),
        (["--jobs", "0"], "jobs is 0"),
    ],
)
def test_what_cannot_be_measured_is_refused_by_name(tmp_path, arguments, field):
    ran = CliRunner().invoke(evaluate, ["draws", "--out", str(tmp_path), *arguments])
    assert ran.exit_code == 2
    assert field in ran.stderr
