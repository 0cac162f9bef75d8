"""Learning inside the pipeline: no frame is lost, no step at a swap, and nothing is learned that is not measured."""

import queue
import threading
from dataclasses import replace

import numpy as np
import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.capture.source import SourceDescription
from engine.control.loop import EngineLoop
from engine.core.clock import ManualClock, MonotonicClock
from engine.core.commands import Retrain
from engine.core.errors import SourceEndedError
from engine.core.frames import LostReason, MeasurementState, RoiDepth
from engine.core.learning_status import LearningEventKind
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.cross_check import cell_surface
from engine.motion.cross_check.cell_surface import learn_shapes
from engine.motion.learning.trainer import BackgroundTrainer, InlineTrainer
from engine.motion.learning.training_set import ALIGNMENT, TrainingFrame
from engine.motion.pipeline import Pipeline
from engine.motion.training_process.process_trainer import ProcessTrainer
from tests.support.motion import small_scene
from tests.support.motion.pipelines import SETTINGS, Played, measuring, new_pipeline

pytestmark = [pytest.mark.slow, pytest.mark.verification]

PATIENT_LIMITS = GateLimits(
    window=amplitude_window(lower_mm=-50.0, upper_mm=50.0),
    max_frame_age_ms=200.0,
    max_gap_ms=200.0,
    max_silence_ms=2000.0,
    watchdog_ms=500.0,
)


@pytest.fixture(scope="module")
def frames():
    """Eight seconds of breath, made once: a test needs many frames, and the camera is not what is tested."""
    return [small_scene.frame(index) for index in range(240)]


@pytest.fixture(scope="module")
def learned(frames):
    pipeline, camera = new_pipeline(), Played(frames)
    while pipeline.learner.status.model is None:
        pipeline.measure(next(camera))
    return pipeline.learner.status.model


def test_the_whole_signal_steps_by_less_than_0_05_mm_at_a_swap_of_a_steady_phantom(learned, frames):
    pipeline, camera = measuring(learned, frames)
    steps = []
    for _ in range(3):
        first = pipeline.learner.status.model
        pipeline.learner.retrain()
        pipeline.learner.keep_model(is_kept=True)
        while not pipeline.learner.status.is_model_waiting:
            assert camera.index < 3000
            assert pipeline.measure(next(camera)).state is MeasurementState.MEASURING
        held = [camera.held(5000 + number) for number in range(60)]
        before = [pipeline.measure(frame).motion.whole_mm for frame in held[:30]]
        pipeline.learner.keep_model(is_kept=False)
        after = [pipeline.measure(frame).motion.whole_mm for frame in held[30:]]
        assert pipeline.learner.status.model is not first
        steps.append(np.mean(after) - np.mean(before))
    assert np.abs(steps).max() < 0.05


def test_a_sheet_that_lies_on_the_patient_is_not_learned_behind_the_reference_s_back(learned, frames):
    pipeline, camera = measuring(learned, frames)
    first = pipeline.learner.status.model
    covered = []
    for shown in frames:
        depth = shown.depth_mm.copy()
        depth[110:380, 230:318] -= 4  # over one side: thin enough to be explained, were it not for how it came
        covered.append(small_scene.frame(shown.index, edit=lambda target, depth=depth: np.copyto(target, depth)))
    sheet = Played(covered)
    for _ in range(30):
        pipeline.measure(next(camera))
    sheet.index = camera.index
    sheet.phase = camera.phase
    lost = [pipeline.measure(next(sheet)).state for _ in range(10)]
    pipeline.learner.retrain()
    lost += [pipeline.measure(next(sheet)).state for _ in range(300)]
    assert set(lost[3:]) == {MeasurementState.LOST}
    assert pipeline.learner.status.model is first
    assert not [notice for notice in pipeline.learner.take_notices() if notice.kind is LearningEventKind.READY]


def waits_for_a_switch(learned, frames):
    """A pipeline that measures with another model waiting, and the camera it looks through."""
    pipeline, camera = measuring(learned, frames)
    pipeline.learner.keep_model(is_kept=True)
    pipeline.learner.retrain()
    while not pipeline.learner.status.is_model_waiting:
        pipeline.measure(next(camera))
        assert camera.index < 1000
    return pipeline, camera


def switch_while_covered(pipeline, camera):
    first = pipeline.learner.status.model
    pipeline.learner.keep_model(is_kept=False)
    for _ in range(3):
        hidden = small_scene.frame(camera.index, corners_px=small_scene.CORNERS_PX[:3])
        assert pipeline.measure(camera.stamped(hidden)).state is MeasurementState.LOST
    assert pipeline.learner.status.model is not first


def test_a_marker_put_elsewhere_while_a_model_takes_over_is_lost(learned, frames):
    pipeline, camera = waits_for_a_switch(learned, frames)
    switch_while_covered(pipeline, camera)
    moved = small_scene.CORNERS_PX.copy()
    moved[3] += (0.0, 8.0)  # 12 mm: a share of the distances in the picture that passes
    outcome = pipeline.measure(camera.stamped(small_scene.frame(camera.index, corners_px=moved)))
    assert outcome.lost.reason is LostReason.LAYOUT_CHANGED
    assert "12 mm" in outcome.lost.detail


def test_a_sheet_laid_while_a_model_takes_over_is_lost(learned, frames):
    def sheet(depth):
        depth[200:300, 270:370] -= 5

    pipeline, camera = waits_for_a_switch(learned, frames)
    pipeline._trust.second_estimate.lost = lambda *_, **__: None  # what is tested works without it
    switch_while_covered(pipeline, camera)
    for index in range(30):
        outcome = pipeline.measure(camera.stamped(small_scene.frame(camera.index, edit=sheet)))
        assert outcome.state is MeasurementState.LOST, index


def test_a_stored_model_is_measured_with_and_accepted_on_the_same_patient(learned, frames):
    pipeline, camera = new_pipeline(), Played(frames)
    pipeline.learner.models.resume(learned)
    while pipeline.learner.status.patient_match is None:
        last = pipeline.measure(next(camera))
        assert camera.index < 400
    assert pipeline.learner.status.patient_match.refusal is None
    assert pipeline.learner.status.patient_match.distance_mm < 5.0
    assert pipeline.learner.status.patient_match.shape_mm < 1.0
    assert last.state is MeasurementState.MEASURING
    assert pipeline.learner.status.model is not None
    assert not pipeline.learner.status.has_reference


class Camera:
    """A source that hands frames over as fast as they are taken, until it is asked to end."""

    def __init__(self, frames, clock):
        self.played, self.clock = Played(frames), clock
        self.end = threading.Event()
        self.given = 0

    def open(self):
        return SourceDescription(
            kind="script", name="scene", depth_size=(640, 480), color_size=(640, 480), fps=30.0, is_live=False
        )

    def read(self, timeout_s):
        assert timeout_s > 0.0
        if self.end.is_set():
            raise SourceEndedError("enough")
        self.given += 1
        return replace(next(self.played), received_ns=self.clock.now_ns())

    def close(self):
        """Nothing is held open."""


@pytest.fixture
def training_process():
    trainer = ProcessTrainer()
    yield trainer
    trainer.close()


def test_a_pipeline_learns_the_same_in_a_training_process(frames, training_process):
    """Model, what projects on it, and the shapes of breathing."""
    here = Pipeline(small_scene.CALIBRATION, SETTINGS, ManualClock(), InlineTrainer())
    there = Pipeline(small_scene.CALIBRATION, SETTINGS, ManualClock(), training_process)
    camera = Played(frames)
    while here.learner.active is None:
        shown = next(camera)
        for pipeline in (here, there):
            pipeline.measure(shown)
    assert training_process.is_busy
    assert training_process.wait(60.0)
    shown = next(camera)
    assert {pipeline.measure(shown).state for pipeline in (here, there)} == {MeasurementState.MEASURING}
    ours, theirs = here.learner.active, there.learner.active
    assert np.array_equal(ours.model.components, theirs.model.components)
    assert np.array_equal(ours.basis.points, theirs.basis.points)
    assert np.array_equal(ours.beside.shapes.terms, theirs.beside.shapes.terms, equal_nan=True)
    assert ours.beside.total == theirs.beside.total > 0


def test_the_first_frame_of_a_model_learns_no_shapes(frames, monkeypatch):
    """The job has learned them; the frame would take milliseconds for it."""
    count = []
    monkeypatch.setattr(
        cell_surface, "learn_shapes", lambda surfaces_mm: count.append(len(surfaces_mm)) or learn_shapes(surfaces_mm)
    )
    pipeline, camera = new_pipeline(), Played(frames)
    while pipeline.learner.status.model is None:
        pipeline.measure(next(camera))
    assert pipeline.measure(next(camera)).state is MeasurementState.MEASURING
    assert len(count) == 1


def test_a_kept_frame_is_a_copy_of_its_own():
    roi = RoiDepth(depth_mm=np.arange(12, dtype=np.float32).reshape(3, 4), valid=np.eye(3, 4, dtype=bool), stride_px=2)
    nodes_px = np.arange(10.0).reshape(5, 2)
    kept = TrainingFrame.kept(roi, 7, nodes_px)
    for copy, original in (
        (kept.roi.depth_mm, roi.depth_mm),
        (kept.roi.valid, roi.valid),
        (kept.nodes_px, nodes_px),
    ):
        assert copy.dtype == original.dtype
        assert np.array_equal(copy, original)
        assert not np.shares_memory(copy, original)
        assert not copy.flags.writeable
        assert copy.ctypes.data % ALIGNMENT == 0
    assert (kept.timestamp_us, kept.roi.stride_px) == (7, 2)


@pytest.mark.parametrize("kind", [BackgroundTrainer, ProcessTrainer])
def test_no_frame_is_lost_while_models_are_learned_and_swapped_in_real_threads(frames, learned, kind, request):
    """Counted: as many measurements as frames, in order, all of them measured, through two retrainings."""
    clock, trainer = MonotonicClock(), kind()
    request.addfinalizer(getattr(trainer, "close", lambda: None))
    camera = Camera(frames, clock)
    pipeline = Pipeline(small_scene.CALIBRATION, SETTINGS, clock, trainer)
    pipeline.learner.activate(learned)
    loop = EngineLoop(
        source=camera,
        measurer=pipeline,
        learner=pipeline.learner,
        beam=SimulatedBeamLine(clock),
        limits=PATIENT_LIMITS,
        clock=clock,
        sample_capacity=100_000,
    )
    records, kinds, asked = [], [], 0
    loop.start()
    while kinds.count(LearningEventKind.SWAPPED) < 3:
        records.append(loop.samples.get(timeout=60.0))
        while True:
            try:
                kinds.append(loop.notices.get_nowait().kind)
            except queue.Empty:
                break
        if kinds.count(LearningEventKind.SWAPPED) > asked:
            asked += 1
            loop.submit(Retrain(operator="ann")).result(timeout=60.0)
        assert not loop.status.is_over, loop.status.error
    camera.end.set()
    assert loop.join(60.0)
    while not loop.samples.empty():
        records.append(loop.samples.get_nowait())
    indices = [record.measurement.frame_index for record in records]
    assert indices == list(range(camera.given))
    states = [record.measurement.state for record in records]
    first = states.index(MeasurementState.MEASURING)
    assert set(states[first:]) == {MeasurementState.MEASURING}
    assert kinds.count(LearningEventKind.READY) == 2
