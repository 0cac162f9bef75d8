"""The camera was away: the pipeline begins anew over the same patient, wherever camera and patient are by now."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import MeasurementState
from engine.core.learning_status import LearningEventKind
from tests.support.motion import small_scene
from tests.support.motion.pipelines import SETTINGS, Played, measuring, new_pipeline

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames():
    return [small_scene.frame(index) for index in range(240)]


@pytest.fixture(scope="module")
def learned(frames):
    pipeline, camera = new_pipeline(), Played(frames)
    while pipeline.learner.status.model is None:
        pipeline.measure(next(camera))
    return pipeline.learner.status.model


@pytest.fixture
def returned(learned, frames):
    """A pipeline whose camera was away for ten seconds."""
    pipeline, camera = measuring(learned, frames)
    pipeline.learner.set_reference()
    for _ in range(40):
        pipeline.measure(next(camera))
    assert pipeline.learner.status.has_reference
    camera.index += 300
    pipeline.camera_returned()
    return pipeline, camera


def test_the_same_camera_over_the_same_patient_measures_at_once_and_asks_for_the_reference(returned):
    pipeline, camera = returned
    model = pipeline.learner.status.model
    states = [pipeline.measure(next(camera)).state for _ in range(3)]
    assert states == [MeasurementState.MEASURING] * 3
    assert "compared" in pipeline.learner.status.model_shortcoming
    while pipeline.learner.status.patient_match is None:
        pipeline.measure(next(camera))
        assert camera.index < 900
    assert pipeline.learner.status.patient_match.refusal is None
    assert pipeline.learner.status.model is model
    assert pipeline.learner.status.model_shortcoming is None
    assert not pipeline.learner.status.has_reference
    pipeline.learner.set_reference()
    pipeline.measure(next(camera))
    assert pipeline.learner.status.has_reference


def test_motion_counts_from_the_reference_that_was_set_after_the_return_alone(returned, frames):
    pipeline, camera = returned
    lower = Played(
        [small_scene.frame(shown.index, edit=lambda depth: np.add(depth, 8, out=depth)) for shown in frames[:60]]
    )
    lower.index, lower.phase = camera.index, 0
    pipeline.measure(next(lower))
    pipeline.learner.set_reference()
    zero = pipeline.measure(next(lower))
    assert zero.state is MeasurementState.MEASURING
    assert abs(zero.motion.whole_mm) < 0.5


def test_a_camera_that_hangs_elsewhere_costs_the_model(returned, frames):
    pipeline, camera = returned
    far = Played(
        [small_scene.frame(shown.index, edit=lambda depth: np.add(depth, 60, out=depth)) for shown in frames[:120]]
    )
    far.index = camera.index
    model = pipeline.learner.status.model
    while pipeline.learner.status.model is model:
        pipeline.measure(next(far))
        assert pipeline.learner.status.model_shortcoming or not pipeline.learner.status.has_reference
        assert far.index < camera.index + 300, "it was never refused"
    assert any(notice.kind is LearningEventKind.REFUSED for notice in pipeline.learner.take_notices())


def test_a_reference_that_a_cold_camera_measured_is_dropped_and_its_distance_is_not_known(learned, frames):
    pipeline, camera = measuring(learned, frames)
    pipeline.learner.set_reference()
    for _ in range(3):
        pipeline.measure(next(camera))
    status = pipeline.learner.status
    assert (status.has_reference, status.reference_distance.distance_mm) == (True, pytest.approx(0.0, abs=1e-6))
    pipeline.learner.take_notices()
    pipeline.camera_warmed()
    (notice,) = pipeline.learner.take_notices()
    assert notice.kind is LearningEventKind.ZERO_NEEDED
    assert notice.detail.startswith("the camera is warm now")
    assert pipeline.learner.status.model_generation > status.model_generation
    pipeline.measure(next(camera))
    assert not pipeline.learner.status.has_reference
    pipeline.learner.set_reference()
    pipeline.measure(next(camera))
    assert pipeline.learner.status.has_reference
    assert pipeline.learner.status.reference_distance.unknown == "it was measured while the camera was cold"


def test_a_model_that_is_noisier_than_its_camera_s_kind_arms_no_gate(learned, frames):
    for most_mm, is_refused in ((learned.noise_mm * 1.01, False), (learned.noise_mm * 0.99, True), (None, False)):
        pipeline = new_pipeline(settings=replace(SETTINGS, most_noise_mm=most_mm))
        pipeline.learner.models.resume(learned)
        camera = Played(frames)
        while pipeline.learner.status.patient_match is None:
            pipeline.measure(next(camera))
        shortcoming = pipeline.learner.status.model_shortcoming
        assert (shortcoming is not None) is is_refused
        assert shortcoming is None or "look for the sun" in shortcoming
