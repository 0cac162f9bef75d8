"""What `tidegate measure` makes of the regular volunteer, for the files that look at it from different sides."""

from pathlib import Path

import pytest

from lab.phantom.truth import load_truth
from tests.support.command_line import Measured, measured_once

PATIENT = ("--patient", "P-0001")
WINDOW = ("--window", "whole:-1:3")


@pytest.fixture(scope="session")
def regular_options(regular_volunteer: Path) -> tuple[str, ...]:
    """Return a window, a patient, and a point for each of those with a true depth."""
    points = load_truth(regular_volunteer / "truth.npz").point_rc
    return (*WINDOW, *PATIENT, *(f"--point={row},{column}" for row, column in points))


@pytest.fixture(scope="session")
def measured_twice(
    regular_volunteer: Path, regular_options: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory
) -> Measured:
    """Return the run in two passes: learned from the whole recording, measured from the first frame on."""
    return measured_once(tmp_path_factory, regular_volunteer, *regular_options)


@pytest.fixture(scope="session")
def measured_live(regular_volunteer: Path, tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """Return the run in one pass, as in a live session."""
    return measured_once(tmp_path_factory, regular_volunteer, *WINDOW, "--single-pass")


@pytest.fixture(scope="session")
def measured_with_model(
    regular_volunteer: Path, measured_twice: Measured, tmp_path_factory: pytest.TempPathFactory
) -> Measured:
    """Return the run with the model that the one in two passes left."""
    model = measured_twice.out / "model.npz"
    return measured_once(tmp_path_factory, regular_volunteer, *PATIENT, model=model)


@pytest.fixture(scope="session")
def measured_hold(dibh_volunteer: Path, tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """Return the run of a breath hold behind 20 s of free breathing, with the model of the whole recording."""
    return measured_once(tmp_path_factory, dibh_volunteer, "--cell", "10")
