"""The figures that `make demo` prints against the truth."""

import numpy as np
import pytest

from service.cli.demo.accuracy import compare

FPS = 30.0
TRUE_US = (np.arange(1800) * 1e6 / FPS).astype(np.int64)
BREATH_MM = 5.0 * (1.0 - np.cos(2.0 * np.pi * TRUE_US / 4e6)) / 2.0
DEPTH_MM = 900.0 - BREATH_MM
ARMED = slice(400, None)


@pytest.mark.parametrize("offset_mm", [0.0, 2.5, -0.3])
def test_a_shifted_reference_is_named_as_such_and_is_no_motion_error(offset_mm):
    found = compare(TRUE_US[ARMED], BREATH_MM[ARMED] + offset_mm, TRUE_US, DEPTH_MM)
    assert found.reference_mm == pytest.approx(offset_mm, abs=1e-3)
    assert np.abs(found.errors_mm).max() < 1e-9


def test_a_frame_that_is_wrong_counts_by_as_much():
    motion_mm = BREATH_MM[ARMED].copy()
    motion_mm[700] += 1.0
    found = compare(TRUE_US[ARMED], motion_mm, TRUE_US, DEPTH_MM)
    assert np.abs(found.errors_mm).max() == pytest.approx(1.0, abs=1e-3)
    assert int(np.abs(found.errors_mm).argmax()) == 700


def test_too_small_an_amplitude_is_a_motion_error():
    found = compare(TRUE_US[ARMED], 0.9 * BREATH_MM[ARMED], TRUE_US, DEPTH_MM)
    assert np.abs(found.errors_mm).max() == pytest.approx(0.25, abs=0.02)


def test_without_an_end_of_exhale_there_is_no_figure():
    assert compare(TRUE_US[:40], BREATH_MM[:40], TRUE_US, DEPTH_MM) is None
