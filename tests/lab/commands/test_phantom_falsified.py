"""``tidegate phantom --falsify``: a recording of the catalogue, and a couch that moves as `tidegate measure` has it."""

import csv
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.evaluation.integrity.cases import cases, falsification_of
from lab.phantom.truth import load_truth
from service.cli import app

pytestmark = [pytest.mark.slow, pytest.mark.verification]

MOVED_AT_S = 24.0


def called(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--falsify", "nonsense"], "falsify is nonsense: must be one of marker hidden, sheet laid over"),
        (["--falsify", "couch lowered", "--size", "3 mm"], "size is 3 mm: must be one of 2 mm, 5 mm"),
        (["--falsify", "couch lowered"], "size is None: must be one of 2 mm, 5 mm"),
        (["--falsify", "frozen picture"], "falsify is frozen picture: must be one of"),
        (["--size", "2 mm"], "falsify is None: must be given where a size is"),
        (["--falsify", "camera shifted", "--seconds", "20"], "falsify_at is 30.0: must be before the end, 20 s"),
        (["--falsify", "camera shifted", "--falsify-at", "-1"], "falsify-at"),
    ],
)
def test_what_the_catalogue_does_not_have_is_refused_with_what_it_has(tmp_path, words, told):
    answer = called("phantom", "regular", "--out", tmp_path / "x", *words)
    assert answer.exit_code == 2
    assert told in " ".join(answer.stderr.replace("'", "").split())
    assert not (tmp_path / "x").exists()


def test_every_kind_of_the_scene_can_be_made_from_any_time_on():
    made = 0
    for case in cases(is_slow=True):
        if case.falsification.stale is None and not case.is_turned and case.kind != "honest":
            assert falsification_of(case.kind, case.size, start_s=7.5).start_s == 7.5
            made += 1
    assert made > 60
    assert falsification_of("camera shifted", None, start_s=1.0).camera.x_mm == 5.0, "one size needs no choice"


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A couch that goes down by 2 mm, measured."""
    folder = tmp_path_factory.mktemp("couch")
    made = called(
        *("phantom", "regular", "--out", folder / "made", "--seconds", 32, "--falsify", "couch lowered"),
        *("--size", "2 mm", "--falsify-at", MOVED_AT_S, "--volunteer", 3),
    )
    assert made.exit_code == 0, made.output
    answer = called("measure", folder / "made" / "recording.oni", "--cell", 10, "--out", folder / "out")
    assert answer.exit_code == 0, answer.output
    return folder, answer.output


def test_no_frame_is_lost_and_each_has_its_movement(measured):
    folder, printed = measured
    with (folder / "out" / "motion.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["state"] for row in rows} == {"measuring"}
    moved = [int(row["frame_index"]) for row in rows if row["lost_reason"] == "camera_moved"]
    assert moved == list(range(moved[0], len(rows)))
    assert abs(moved[0] / 30.0 - MOVED_AT_S) < 0.6
    before, after = json.loads((folder / "out" / "motion_summary.json").read_text())["segments"]
    assert (before["cause"], after["cause"]) == ("start", "camera_moved")
    assert after["moved"]["height_mm"] == pytest.approx(-2.0, abs=0.2)
    assert abs(after["moved"]["shift_y_mm"]) < 0.5
    assert f"Segment 1, frames {moved[0]} to {len(rows) - 1}: camera_moved" in " ".join(printed.split())


def test_the_motion_is_the_patients_and_the_couchs(measured):
    folder, _ = measured
    truth = load_truth(folder / "made" / "truth.npz")
    with np.load(folder / "out" / "regions.npz") as found:
        motion_mm = found["motion_mm"]
    true_mm = truth.cell_depth_mm[0] - truth.cell_depth_mm
    is_seen = np.isfinite(motion_mm).all(axis=0)
    error_mm = (motion_mm - true_mm)[:, is_seen]
    first = round(MOVED_AT_S * 30.0)
    assert np.abs(error_mm[: first - 5]).mean() < 0.15
    after_mm = error_mm[first + 30 :]
    assert np.median(after_mm) == pytest.approx(-2.0, abs=0.2)
    assert np.abs(after_mm - np.median(after_mm)).mean() < 0.15
