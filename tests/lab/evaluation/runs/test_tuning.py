"""Constants are chosen without a part of the recordings and judged on it, and every constant is one of the method."""

import importlib

import pytest
from typer.testing import CliRunner

from lab.commands.evaluate.command import evaluate
from lab.evaluation.runs import tuning
from lab.evaluation.runs.draws import runs
from lab.evaluation.runs.tuning import CONSTANTS, Tuned, table, tune


@pytest.mark.parametrize("constant", CONSTANTS, ids=lambda one: one.name)
def test_the_shipped_value_is_the_module_s_and_the_others_are_not(constant):
    assert constant.values[0][1] is None
    for _, patches in constant.values[1:]:
        shipped = [str(getattr(importlib.import_module(module), name)) for module, name in patches]
        assert constant.values[0][0].replace(".0", "") == ", ".join(shipped).replace(".0", "")
        assert [str(value) for value in patches.values()] != shipped


def test_each_value_is_in_place_while_it_is_measured(monkeypatch, tmp_path):
    seen = []
    module = importlib.import_module("engine.motion.learning.shape_smoothing")
    monkeypatch.setattr(tuning, "make_dataset", lambda *_: None)
    monkeypatch.setattr(tuning, "_error_mm", lambda _: seen.append(module.CAUTION) or 0.1)
    found = tune(runs(2017, 100, 1, ("dibh",))[0], tmp_path)
    assert sorted(set(seen)) == [1.3, 3.0, 5.0]
    assert len(found.errors_mm) == sum(len(one.values) for one in CONSTANTS)


def test_a_value_is_chosen_without_the_part_that_judges_it():
    shipped = {(one.name, value): 0.1 for one in CONSTANTS for value, _ in one.values}
    # The second value is best on both sensors but for one recording of the second, which is far worse with it.
    changed = ("CAUTION", CONSTANTS[1].values[1][0])
    errors = {("drawn-100", "regular"): 0.09, ("drawn-100", "dibh"): 0.09, ("drawn-101", "regular"): 0.09}
    found = [
        Tuned(run=run, errors_mm={**shipped, changed: errors.get((run.sensor, run.scenario), 0.4)})
        for run in runs(2017, 100, 2, ("regular", "dibh"))
    ]
    row = next(row for row in table(found).rows if row[0] == "CAUTION")
    assert row[2:4] == ("3.0; 1.3", "3.0; 1.3")
    assert row[4:] == pytest.approx((0.1, (0.1 + 0.1 + 0.09 + 0.4) / 4, (0.1 + 0.1 + 0.09 + 0.4) / 4))


def test_what_cannot_be_tuned_on_is_refused_by_name(tmp_path):
    ran = CliRunner().invoke(evaluate, ["tune", "--out", str(tmp_path), "--scenario", "yoga"])
    assert ran.exit_code == 2
    assert "scenario is 'yoga'" in ran.stderr
