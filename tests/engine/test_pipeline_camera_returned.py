"""The camera was away: the pipeline begins anew over the same patient, wherever camera and patient are by now."""

import numpy as np
import pytest

from engine.frames import MeasurementState
from engine.notices import NoticeKind
from tests.engine import scene
from tests.engine.test_pipeline_models import Played, measuring, new_pipeline


@pytest.fixture(scope="module")
def frames():
    return [scene.frame(index) for index in range(240)]


@pytest.fixture(scope="module")
def learned(frames):
    pipeline, camera = new_pipeline(), Played(frames)
    while pipeline.model is None:
        pipeline.measure(next(camera))
    return pipeline.model


@pytest.fixture
def returned(learned, frames):
    """A pipeline whose camera was away for ten seconds."""
    pipeline, camera = measuring(learned, frames)
    for _ in range(40):
        pipeline.measure(next(camera))
    assert pipeline.has_reference
    camera.index += 300
    pipeline.camera_returned()
    return pipeline, camera


def test_the_same_camera_over_the_same_patient_measures_at_once_and_asks_for_the_zero(returned):
    pipeline, camera = returned
    model = pipeline.model
    states = [pipeline.measure(next(camera)).state for _ in range(3)]
    assert states == [MeasurementState.MEASURING] * 3
    assert "compared" in pipeline.model_shortcoming
    while pipeline.likeness is None:
        pipeline.measure(next(camera))
        assert camera.index < 900
    assert pipeline.likeness.refusal is None
    assert pipeline.model is model
    assert pipeline.model_shortcoming is None
    assert not pipeline.has_reference
    pipeline.set_reference()
    pipeline.measure(next(camera))
    assert pipeline.has_reference


def test_motion_counts_from_the_zero_that_was_set_after_the_return_alone(returned, frames):
    pipeline, camera = returned
    lower = Played([scene.frame(shown.index, edit=lambda depth: np.add(depth, 8, out=depth)) for shown in frames[:60]])
    lower.index, lower.phase = camera.index, 0
    pipeline.measure(next(lower))
    pipeline.set_reference()
    zero = pipeline.measure(next(lower))
    assert zero.state is MeasurementState.MEASURING
    assert abs(zero.motion.whole_mm) < 0.5


def test_a_camera_that_hangs_elsewhere_costs_the_model(returned, frames):
    pipeline, camera = returned
    far = Played([scene.frame(shown.index, edit=lambda depth: np.add(depth, 60, out=depth)) for shown in frames[:120]])
    far.index = camera.index
    model = pipeline.model
    while pipeline.model is model:
        pipeline.measure(next(far))
        assert pipeline.model_shortcoming or not pipeline.has_reference
        assert far.index < camera.index + 300, "it was never refused"
    assert any(notice.kind is NoticeKind.REFUSED for notice in pipeline.take_notices())
