"""The zero is where the last half second says the patient is, not where one noisy frame does."""

import numpy as np
import pytest

from engine.core.frames import RoiDepth
from engine.motion.learning.prepared_model import prepare_model
from engine.motion.learning.reference_transfer import FRAMES, RecentFrames
from engine.motion.stages.projection import STRIDE_PX, modes_of, project
from engine.motion.stages.regions import RegionLayout
from tests.support.motion.fitting_frames import BREATH, REST_MM, frames, learn

FRAME_US = 33_367
# Four seconds a breath.
SIGNAL_MM = 4.0 - 4.0 * np.cos(np.arange(120) * 2.0 * np.pi / 120)
THIN = (slice(None, None, STRIDE_PX),) * 2


@pytest.fixture(scope="module")
def active():
    return prepare_model(learn(*frames(1.0, blur_px=1.0), components=1), RegionLayout())


def roi(amplitude_mm, seed, noise_mm=1.0):
    surface = REST_MM - amplitude_mm * BREATH
    noise = np.random.default_rng(seed).normal(0.0, noise_mm, surface.shape)
    depth = (surface + noise).astype(np.float32)[THIN]
    return RoiDepth(depth_mm=depth, valid=np.ones(depth.shape, dtype=bool), stride_px=STRIDE_PX)


def surface_error_mm(active, coefficients, amplitude_mm):
    surface = active.model.mean_mm + np.tensordot(coefficients, modes_of(active.model), axes=1)
    return np.abs(surface - (REST_MM - amplitude_mm * BREATH)).mean()


def fill(recent, active, amplitudes_mm, seed=0, noise_mm=4.0):
    for index, amplitude in enumerate(amplitudes_mm):
        newest = roi(amplitude, 1000 * seed + index, noise_mm)
        recent.add(newest, index * FRAME_US)
    return project(active.basis, newest, None)


def test_a_breath_in_full_swing_is_followed_without_lag_and_with_less_noise(active):
    amplitudes = SIGNAL_MM[10 : 10 + FRAMES]
    alone, together = [], []
    for seed in range(8):
        recent = RecentFrames()
        newest = fill(recent, active, amplitudes, seed)
        alone.append(surface_error_mm(active, newest.coefficients, amplitudes[-1]))
        together.append(surface_error_mm(active, recent.smoothed(active, newest).coefficients, amplitudes[-1]))
    assert np.mean(together) < 0.9 * np.mean(alone)


def test_without_noise_it_is_the_newest_frame(active):
    recent = RecentFrames()
    newest = fill(recent, active, SIGNAL_MM[10 : 10 + FRAMES], noise_mm=0.0)
    settled = recent.smoothed(active, newest).coefficients
    assert abs(settled[0] - newest.coefficients[0]) * np.abs(active.model.components[0]).max() < 0.03


def test_a_slow_camera_is_not_averaged_over_half_a_breath(active):
    recent = RecentFrames()
    amplitudes = 4.0 - 4.0 * np.cos(np.arange(40) * 2.0 * np.pi / 40)  # four seconds at ten frames a second
    for index, amplitude in enumerate(amplitudes[:20]):
        newest = roi(amplitude, index, 0.0)
        recent.add(newest, index * 99_000)
    found = project(active.basis, newest, None)
    alone_mm = surface_error_mm(active, found.coefficients, amplitudes[19])
    assert surface_error_mm(active, recent.smoothed(active, found).coefficients, amplitudes[19]) < alone_mm + 0.02


def test_too_few_frames_or_a_gap_leave_the_newest_alone(active):
    recent = RecentFrames()
    newest = fill(recent, active, SIGNAL_MM[10:16])
    assert recent.smoothed(active, newest).coefficients is newest.coefficients
    fill(recent, active, SIGNAL_MM[10 : 10 + FRAMES])
    recent.add(roi(3.0, 5), 10_000_000)
    assert recent.smoothed(active, newest).coefficients is newest.coefficients


def test_what_was_forgotten_has_no_say(active):
    recent = RecentFrames()
    newest = fill(recent, active, SIGNAL_MM[10 : 10 + FRAMES])
    recent.reset()
    assert recent.smoothed(active, newest).coefficients is newest.coefficients


def test_a_place_that_was_seen_in_some_of_the_frames_has_their_share(active):
    recent = RecentFrames()
    for index in range(FRAMES):
        valid = np.ones((88, 50), dtype=bool)
        valid[70:] = index < 9
        depth = roi(3.0, index, 0.1).depth_mm
        newest = RoiDepth(depth_mm=depth, valid=valid, stride_px=STRIDE_PX)
        recent.add(newest, index * FRAME_US)
    seen = recent.smoothed(active, project(active.basis, newest, None)).seen
    assert (seen[:70] == 1.0).all()
    assert seen[70:] == pytest.approx(9 / FRAMES)
