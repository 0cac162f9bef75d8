"""`tidegate measure` reads a recording twice: every frame is measured, and what a live session shows is known."""

import numpy as np
import pytest

from engine.core.errors import ModelError
from engine.motion.learning import refit
from engine.motion.learning.model_file import load_model
from lab.phantom.truth import load_truth
from tests.support.command_line import measured

pytestmark = pytest.mark.verification


def test_every_frame_is_measured_also_those_of_the_training(measured_twice, measured_live):
    rows, summary, said = measured_twice.rows, measured_twice.summary, measured_twice.said
    live_rows, live_summary = measured_live.rows, measured_live.summary
    assert {row["state"] for row in rows} == {"measuring"}
    assert (summary["passes"], live_summary["passes"]) == (2, 1)
    first = next(index for index, row in enumerate(live_rows) if row["state"] == "measuring")
    assert summary["live_from_frame"] == live_summary["live_from_frame"] == first > 200
    assert f"measured from frame {first} on" in said
    assert {row["state"] for row in live_rows[:first]} == {"training"}


def test_the_frames_of_the_training_are_as_true_as_the_others(measured_twice, regular_volunteer):
    """The first frame is the reference."""
    rows, summary = measured_twice.rows, measured_twice.summary
    truth = load_truth(regular_volunteer / "truth.npz").whole_depth_mm
    error_mm = np.array([float(row["whole_mm"]) for row in rows]) - (truth[0] - truth)
    assert np.abs(error_mm[: summary["live_from_frame"]]).mean() < 0.12
    assert np.abs(error_mm).max() < 0.4


def test_both_passes_measure_the_same_but_for_the_reference(measured_twice, measured_live):
    rows, live_rows = measured_twice.rows, measured_live.rows
    first = measured_twice.summary["live_from_frame"]
    one, other = (np.array([float(row["whole_mm"]) for row in which[first:]]) for which in (rows, live_rows))
    # The second pass is smoothed over seven frames: the noise of a frame is in the other alone.
    assert np.ptp(np.convolve(one - other, np.full(7, 1.0 / 7.0), mode="valid")) < 0.05


def test_frames_before_the_model_are_held_and_the_others_decided(measured_twice, measured_live):
    rows, live_rows = measured_twice.rows, measured_live.rows
    first = measured_twice.summary["live_from_frame"]
    assert {(row["gate"], row["hold_reason"]) for row in rows[:first]} == {("hold", "training")}
    assert {(row["gate"], row["hold_reason"]) for row in live_rows[:first]} == {("disarmed", "disarmed")}
    on = [float(row["whole_mm"]) for row in rows[first:] if row["gate"] == "beam_on"]
    assert len(on) > 10
    assert -1.0 <= min(on) <= max(on) <= 3.0


def test_a_stored_model_measures_from_the_first_frame_on(measured_with_model):
    assert {row["state"] for row in measured_with_model.rows} == {"measuring"}
    assert 0 < measured_with_model.summary["live_from_frame"] < 30


@pytest.fixture(scope="module")
def held(measured_hold):
    return measured_hold.out


@pytest.fixture(scope="module")
def held_first(dibh_volunteer, tmp_path_factory):
    """The same, measured with the first model to the end."""
    out = tmp_path_factory.mktemp("held-first")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refit, "GROWTH", 1e9)
        measured(dibh_volunteer, out, "--cell", "10", "--single-pass")
    return out


def hold_error_mm(folder, out):
    """Mean error of the cells' motion in the hold, whatever the reference: its mean over the free breathing is 0."""
    depth_mm = load_truth(folder / "truth.npz").cell_depth_mm
    with np.load(out / "regions.npz") as regions:
        motion_mm, frames = regions["motion_mm"], regions["frame_index"]
    error_mm = motion_mm + depth_mm[frames]
    error_mm = error_mm[:, np.isfinite(error_mm[frames > 15 * 30]).all(axis=0)]
    is_hold = frames > 23 * 30
    is_free = (frames > 15 * 30) & (frames < 19 * 30)
    return float(np.abs(error_mm[is_hold] - error_mm[is_free].mean(axis=0)).mean())


def test_the_second_pass_has_learned_from_the_whole_recording(dibh_volunteer, held, held_first):
    whole, training = load_model(held / "model.npz"), load_model(held_first / "model.npz")
    assert training.seconds < 20.0
    assert whole.seconds > 30.0
    assert whole.depth_steps == training.depth_steps
    assert hold_error_mm(dibh_volunteer, held) < 0.85 * hold_error_mm(dibh_volunteer, held_first)


def test_a_session_s_refits_know_breath_holds(dibh_volunteer, held_first, tmp_path):
    measured(dibh_volunteer, tmp_path, "--cell", "10", "--single-pass")
    first, refitted = load_model(held_first / "model.npz"), load_model(tmp_path / "model.npz")
    assert refitted.seconds >= 2.0 * first.seconds
    assert hold_error_mm(dibh_volunteer, tmp_path) < 0.95 * hold_error_mm(dibh_volunteer, held_first)


def test_where_the_whole_recording_gives_no_model_that_of_the_training_measures(
    dibh_volunteer, held_first, tmp_path, monkeypatch
):
    def refused(*_arguments):
        raise ModelError("refused")

    monkeypatch.setattr(refit, "fit_checked", refused)
    measured(dibh_volunteer, tmp_path)
    whole, training = load_model(tmp_path / "model.npz"), load_model(held_first / "model.npz")
    assert np.array_equal(whole.components, training.components)
