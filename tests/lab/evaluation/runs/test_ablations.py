"""The variants change what they say they change, for as long as they measure, and are laid out side by side."""

import importlib

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from lab.evaluation.runs import ablations
from lab.evaluation.runs.ablations import VARIANTS, Ablation, ablate, runs, table


def in_place(variant):
    return {place: getattr(importlib.import_module(place[0]), place[1]) for place in variant.patches}


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_a_variant_puts_another_value_in_place_and_the_shipped_one_back(variant):
    shipped = in_place(variant)
    with variant.applied():
        assert in_place(variant) == dict(variant.patches)
        assert all(value != shipped[place] for place, value in variant.patches.items())
    assert in_place(variant) == shipped


def test_each_kind_of_recording_is_measured_once():
    planned = runs(2017)
    assert [run.scenario for run in planned] == ["regular", "irregular", "shift", "dibh", "isovolume", "drift"]
    assert {run.sensor for run in planned} == {"usual"}


def test_the_other_sensor_records_the_same_volunteers_in_folders_of_their_own():
    usual, locking = runs(2017), runs(2017, "locking")
    assert [run.recipe | {"sensor": "locking"} for run in usual] == [run.recipe for run in locking]
    assert not {run.name for run in usual} & {run.name for run in locking}


def test_some_scenarios_alone_are_measured_and_others_refused():
    assert [run.name for run in runs(2017, "locking", ("dibh", "regular"))] == ["D02-locking", "H01-locking"]
    with pytest.raises(InvalidValueError, match="scenario"):
        runs(2017, "usual", ("cough",))
    with pytest.raises(InvalidValueError, match="sensor"):
        runs(2017, "lidar")


def test_a_variant_without_what_helps_is_worse(regular_volunteer, monkeypatch):
    chosen = [variant for variant in VARIANTS if variant.name in {"as shipped", "cosines under one wide prior"}]
    monkeypatch.setattr(ablations, "VARIANTS", chosen)
    monkeypatch.setattr(ablations, "make_dataset", lambda *_: None)
    counted = []
    found = ablate(runs(2017)[0], regular_volunteer, counted.append)
    shipped_mm, wide_mm = found.mean_mm
    assert shipped_mm < 0.12
    assert wide_mm > 1.15 * shipped_mm
    assert all(worst > mean for worst, mean in zip(found.worst_mm, found.mean_mm, strict=True))
    assert counted == list(range(1, len(counted) + 1))


def test_the_table_has_a_row_a_variant_and_two_columns_a_recording():
    numbers = tuple(np.arange(len(VARIANTS)) / 10.0)
    shown = table([Ablation(run=run, mean_mm=numbers, worst_mm=numbers) for run in runs(2017)[:2]])
    assert shown.columns == ("variant", "regular", "regular, worst frame", "irregular", "irregular, worst frame")
    assert [row[0] for row in shown.rows] == [variant.name for variant in VARIANTS]
    assert shown.rows[3][1:] == (0.3, 0.3, 0.3, 0.3)
