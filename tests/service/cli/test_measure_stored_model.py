"""`tidegate measure --model`: a stored model measures the same patient, and is refused for any other."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from engine.motion.learning.model_file import load_model, save_model
from lab.phantom.truth import load_truth
from tests.support.command_line import invoke

pytestmark = [pytest.mark.slow, pytest.mark.verification]

PATIENT = ("--patient", "P-0001")


@pytest.fixture(scope="module")
def learned(measured_twice):
    """A model of volunteer 1, as the command leaves it."""
    return measured_twice.out


@pytest.fixture(scope="module")
def short_volunteer(regular_volunteer, tmp_path_factory):
    """The same patient for a few seconds: a fifth of the recording, too short to learn from."""
    folder = tmp_path_factory.mktemp("short")
    shutil.copy(regular_volunteer / "calibration.json", folder)
    whole = (regular_volunteer / "recording.oni").read_bytes()
    (folder / "recording.oni").write_bytes(whole[: len(whole) // 4])
    return folder


def rows_of(out):
    with (out / "motion.csv").open() as file:
        return list(csv.DictReader(file))


def changed_model(learned, tmp_path, **changes):
    path = tmp_path / "changed.npz"
    save_model(replace(load_model(learned / "model.npz"), **changes), path)
    return path


def test_a_model_states_what_made_it(learned):
    """That the same recording gives the same bytes of it: test_measure.py."""
    model = load_model(learned / "model.npz")
    origin, quality = model.provenance.origin, model.provenance.quality
    assert (origin.patient, origin.source, origin.created_at) == ("P-0001", "recording.oni", "")
    assert origin.software.startswith("tidegate ")
    assert quality.amplitude_mm > 4.0
    assert quality.shift_mm < 1.0
    assert model.provenance.settings["components"] == 6.0


def test_a_stored_model_measures_from_the_first_frames_on_and_is_as_true_as_one_learned_here(
    learned, regular_volunteer, measured_with_model
):
    rows = measured_with_model.rows
    measured = np.array([row["state"] == "measuring" for row in rows])
    assert measured.sum() > len(rows) - 40
    motion = np.array([float(row["whole_mm"] or "nan") for row in rows])[measured]
    depth_mm = load_truth(regular_volunteer / "truth.npz").whole_depth_mm[measured]
    error = motion + depth_mm
    assert np.abs(error - error.mean()).mean() < 0.12
    assert load_model(measured_with_model.out / "model.npz").provenance == load_model(learned / "model.npz").provenance


def test_without_a_patient_to_compare_the_command_reports_no_comparison(learned, short_volunteer, tmp_path):
    result = invoke(short_volunteer, tmp_path / "out", "--model", str(learned / "model.npz"))
    assert "not checked" in result.output
    assert rows_of(tmp_path / "out")[-1]["state"] == "measuring"


@pytest.mark.parametrize("origin", ["another", "none"])
def test_a_model_of_another_or_no_patient_is_refused_before_anything_is_written(
    learned, short_volunteer, tmp_path, origin
):
    provenance = load_model(learned / "model.npz").provenance
    other = None if origin == "none" else replace(provenance.origin, patient="P-0002")
    path = changed_model(learned, tmp_path, provenance=replace(provenance, origin=other))
    result = invoke(short_volunteer, tmp_path / "out", "--model", str(path), *PATIENT)
    assert result.exit_code == 2
    assert "model.patient" in result.output
    assert "P-0002" not in result.output
    assert not (tmp_path / "out").exists()


def test_a_model_of_another_calibration_is_refused_before_anything_is_written(learned, short_volunteer, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(short_volunteer, folder)
    document = json.loads((folder / "calibration.json").read_text())
    document["depth"]["fx"] += 0.5
    (folder / "calibration.json").write_text(json.dumps(document))
    result = invoke(folder, tmp_path / "out", "--model", str(learned / "model.npz"))
    assert result.exit_code == 2
    assert "model.calibration_sha256" in result.output
    assert not (tmp_path / "out").exists()


def test_a_patient_who_lies_elsewhere_is_refused_with_the_figure_and_leaves_no_half_written_file(
    learned, short_volunteer, tmp_path
):
    surface_mm = np.add(load_model(learned / "model.npz").surface_mm, (0.0, 35.0, 0.0))
    path = changed_model(learned, tmp_path, surface_mm=surface_mm)
    result = invoke(short_volunteer, tmp_path / "out", "--model", str(path))
    assert result.exit_code == 2
    assert "model.shift_mm is 35" in " ".join(result.output.split())
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("content", [None, b"", b"not a model"], ids=str)
def test_what_is_no_model_is_one_line_and_exit_2(short_volunteer, tmp_path, content):
    path = tmp_path / "model.npz"
    if content is not None:
        path.write_bytes(content)
    result = invoke(short_volunteer, tmp_path / "out", "--model", str(path))
    assert result.exit_code == 2
    assert "no motion model" in " ".join(result.output.split())
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()
