"""The reference of a second pass is its first measured frame, with less of that frame's noise."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import LostReason, MeasurementState
from engine.motion.learning.prepared_model import Reference
from engine.offline.first_reference import first_frames
from tests.support.gating.streams import measured, motion_of, unmeasured

NOISE_MM = 0.2
CELLS, WIDE = 14 * 8, 3


def breathing(index, rng):
    """A frame of a breath that begins fast, with noise that is the same in no two frames."""
    seconds = index / 30.0
    noise = rng.normal(0.0, NOISE_MM, 5)
    level_mm = 6.0 * seconds - 3.0 * seconds**2
    motion = motion_of(
        level_mm + noise[0],
        thorax_mm=level_mm + noise[1],
        abdomen_mm=level_mm + noise[2],
        regions_mm=level_mm + noise[3],
    )
    return measured(index, replace(motion, volume_l=0.1 * (level_mm + noise[4])))


def relative(frames):
    """The same frames with the first as the reference, as a pipeline measures them."""
    first = next(frame.motion for frame in frames if frame.motion is not None)

    def moved(motion):
        return replace(
            motion,
            whole_mm=motion.whole_mm - first.whole_mm,
            thorax_mm=motion.thorax_mm - first.thorax_mm,
            abdomen_mm=motion.abdomen_mm - first.abdomen_mm,
            volume_l=motion.volume_l - first.volume_l,
            regions_mm=motion.regions_mm - first.regions_mm,
        )

    return [frame if frame.motion is None else replace(frame, motion=moved(frame.motion)) for frame in frames]


REFERENCE = Reference(
    regions_mm=np.full(CELLS + WIDE, 850.0),
    plane_mm=860.0,
    volume_l=1.0,
    seen_shares=np.ones(CELLS + WIDE),
    surface_mm=np.full((135, 3), 850.0),
)


def test_the_noise_of_the_first_frame_is_reduced_by_a_quarter_without_lag():
    before, after = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        frames = [breathing(index, rng) for index in range(30)]
        noise_mm = frames[0].motion.whole_mm  # the true level of the first frame is 0
        smoothed = first_frames(relative(frames)).smoothed(REFERENCE)
        # Depth of the first frame as measured is 850 mm; where it truly was, the noise is added.
        before.append(noise_mm)
        after.append(850.0 + noise_mm - smoothed.regions_mm[CELLS])
    assert np.std(after) < 0.85 * np.std(before)
    assert abs(np.mean(after)) < 0.05


def test_all_regions_and_the_volume_are_smoothed():
    smoothed = first_frames(relative([breathing(index, np.random.default_rng(index)) for index in range(30)])).smoothed(
        REFERENCE
    )
    assert (smoothed.regions_mm != 850.0).all()
    assert smoothed.volume_l != 1.0
    assert smoothed.plane_mm == REFERENCE.plane_mm


def lost(index):
    return unmeasured(measured(index), MeasurementState.LOST, LostReason.MARKER_LOST)


@pytest.mark.parametrize(
    ("frames", "is_smoothed"),
    [
        (lambda rng: [lost(0), lost(1), *(breathing(index, rng) for index in range(2, 30))], True),
        (lambda rng: [*(breathing(index, rng) for index in range(4)), lost(4), breathing(5, rng)], False),
        (
            lambda rng: [*(breathing(index, rng) for index in range(4)), *(breathing(i, rng) for i in range(40, 60))],
            False,
        ),
        (lambda _rng: [lost(0)], False),
        (lambda _rng: [], False),
    ],
    ids=["lost at first", "lost soon", "gap", "never measured", "no frame"],
)
def test_too_few_frames_in_a_row_leave_the_reference_as_it_is(frames, is_smoothed):
    made = frames(np.random.default_rng(1))
    measured_ones = relative(made) if any(frame.motion is not None for frame in made) else made
    found = first_frames(measured_ones).smoothed(REFERENCE)
    assert (found is not REFERENCE) == is_smoothed


def test_no_more_frames_are_read_than_are_needed():
    rng = np.random.default_rng(0)
    unread = iter([breathing(index, rng) for index in range(40)])
    first_frames(unread)
    assert len(list(unread)) == 25


def test_an_unknown_region_stays_unknown_and_spoils_no_other():
    frames = relative([breathing(index, np.random.default_rng(index)) for index in range(30)])
    hidden = []
    for frame in frames:
        regions_mm = frame.motion.regions_mm.copy()
        regions_mm[3, 4] = np.nan
        hidden.append(replace(frame, motion=replace(frame.motion, regions_mm=regions_mm)))
    smoothed = first_frames(hidden).smoothed(REFERENCE)
    assert np.isfinite(smoothed.regions_mm).all()
    assert (np.delete(smoothed.regions_mm, 3 * 8 + 4) != 850.0).all()
