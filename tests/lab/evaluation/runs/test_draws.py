"""Drawn sensors: which recordings are measured, that the curve is left on once, and what the table says of them."""

import pytest
from typer.testing import CliRunner

from lab.commands.evaluate.command import evaluate
from lab.evaluation.runs import draws
from lab.evaluation.runs.draws import LONG_S, DrawnErrors, measure, runs, table


def test_each_draw_has_each_kind_of_breathing_once_on_a_sensor_of_its_own():
    planned = runs(2017, 3, 2, ("regular", "isovolume"))
    assert [(run.sensor, run.scenario) for run in planned] == [
        (f"drawn-{number}", scenario) for number in (3, 4) for scenario in ("regular", "isovolume")
    ]
    assert len({run.name for run in planned}) == 4
    assert not any(run.has_instruments for run in planned)


def test_only_what_is_judged_live_is_long():
    regular, isovolume = runs(2017, 0, 1, ("regular", "isovolume"))
    assert regular.seconds == LONG_S > isovolume.seconds


def test_a_recording_is_measured_whole_live_and_by_the_simple_method(tmp_path, regular_volunteer, monkeypatch):
    monkeypatch.setattr(draws, "make_dataset", lambda *_: None)
    monkeypatch.setattr(draws, "SETTLED_US", 5_000_000)
    one = measure(runs(2017, 0, 1, ("regular",))[0], regular_volunteer)
    assert 0.02 < one.constants_out_mm < one.whole_mm < one.smoothed_mm < 0.3
    assert one.whole_mm / 1.5 < one.live_mm < 2.5 * one.whole_mm
    assert one.whole_mm / 1.5 < one.settled_mm < 1.5 * one.whole_mm
    assert one.stated_mm / 2.5 < one.reference_mm < 2.5 * one.stated_mm
    assert 0.005 < one.gain_sd < 0.1


def test_the_table_ends_each_kind_of_breathing_with_its_mean_and_its_worst():
    found = [DrawnErrors(runs(2017, at, 1, ("regular",))[0], *(0.1 * at + 0.01 * i for i in range(8))) for at in (0, 1)]
    made = table(found)
    assert [row[0] for row in made.rows] == ["drawn-0", "drawn-1", "mean", "worst"]
    assert made.rows[2][2:] == pytest.approx([0.05 + 0.01 * i for i in range(8)])
    assert made.rows[3][2:] == pytest.approx([0.1 + 0.01 * i for i in range(8)])


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
