"""`tidegate measure` reads a recording twice: every frame is measured, and what a live session shows is known."""

import csv
import json

import numpy as np
import pytest

from engine.verification.phantom.truth import load_truth
from tests.support.command_line import invoke

WINDOW = ("--window", "whole:-1:3")


def run(folder, out, *extra):
    result = invoke(folder, out, *extra)
    assert result.exit_code == 0, result.output
    with (out / "motion.csv").open() as file:
        return list(csv.DictReader(file)), json.loads((out / "motion_summary.json").read_text()), result.stderr


@pytest.fixture(scope="module")
def twice(regular_volunteer, tmp_path_factory):
    out = tmp_path_factory.mktemp("twice")
    return *run(regular_volunteer, out, *WINDOW), out


@pytest.fixture(scope="module")
def live(regular_volunteer, tmp_path_factory):
    out = tmp_path_factory.mktemp("live")
    return *run(regular_volunteer, out, *WINDOW, "--single-pass"), out


def test_every_frame_is_measured_also_those_of_the_training(twice, live):
    rows, summary, said, _ = twice
    live_rows, live_summary, _, _ = live
    assert {row["state"] for row in rows} == {"measuring"}
    assert (summary["passes"], live_summary["passes"]) == (2, 1)
    first = next(index for index, row in enumerate(live_rows) if row["state"] == "measuring")
    assert summary["live_from_frame"] == live_summary["live_from_frame"] == first > 200
    assert f"measured from frame {first} on" in said
    assert {row["state"] for row in live_rows[:first]} == {"training"}


def test_the_frames_of_the_training_are_as_true_as_the_others(twice, regular_volunteer):
    """The first frame is the reference."""
    rows, summary, _, _ = twice
    truth = load_truth(regular_volunteer / "truth.npz").whole_depth_mm
    error_mm = np.array([float(row["whole_mm"]) for row in rows]) - (truth[0] - truth)
    assert np.abs(error_mm[: summary["live_from_frame"]]).mean() < 0.12
    assert np.abs(error_mm).max() < 0.4


def test_both_passes_measure_the_same_but_for_the_reference(twice, live):
    (rows, summary, _, _), (live_rows, _, _, _) = twice, live
    first = summary["live_from_frame"]
    one, other = (np.array([float(row["whole_mm"]) for row in which[first:]]) for which in (rows, live_rows))
    assert np.ptp(one - other) < 0.05


def test_frames_before_the_model_are_held_and_the_others_decided(twice, live):
    (rows, summary, _, _), (live_rows, _, _, _) = twice, live
    first = summary["live_from_frame"]
    assert {(row["gate"], row["hold_reason"]) for row in rows[:first]} == {("hold", "training")}
    assert {(row["gate"], row["hold_reason"]) for row in live_rows[:first]} == {("disarmed", "disarmed")}
    on = [float(row["whole_mm"]) for row in rows[first:] if row["gate"] == "beam_on"]
    assert len(on) > 10
    assert -1.0 <= min(on) <= max(on) <= 3.0


def test_a_stored_model_measures_from_the_first_frame_on(twice, regular_volunteer, tmp_path):
    rows, summary, _ = run(regular_volunteer, tmp_path, "--model", str(twice[-1] / "model.npz"))
    assert {row["state"] for row in rows} == {"measuring"}
    assert 0 < summary["live_from_frame"] < 30
