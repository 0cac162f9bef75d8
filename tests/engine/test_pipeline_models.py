"""Learning inside the pipeline: no frame is lost, no step at a swap, and nothing is learned that is not measured."""

import queue
import threading
from dataclasses import replace

import numpy as np
import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.capture.source import SourceDescription
from engine.clock import ManualClock, MonotonicClock
from engine.commands import Retrain
from engine.errors import SourceEndedError
from engine.frames import MeasurementState
from engine.likeness import LikenessLimits
from engine.limits import GateLimits
from engine.loop import EngineLoop
from engine.notices import NoticeKind
from engine.pipeline import Pipeline, PipelineSettings
from engine.training import BackgroundTrainer, InlineTrainer, TrainingSettings
from engine.windows import amplitude_window
from tests.engine import scene

SETTINGS = PipelineSettings(
    training=TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=1, max_seconds=20.0),
    likeness=LikenessLimits(seconds=1.0),
)
PATIENT_LIMITS = GateLimits(
    window=amplitude_window(lower_mm=-50.0, upper_mm=50.0),
    max_frame_age_ms=200.0,
    max_gap_ms=200.0,
    max_silence_ms=2000.0,
    watchdog_ms=500.0,
)


def new_pipeline(trainer=None, settings=SETTINGS):
    return Pipeline(scene.CALIBRATION, settings, ManualClock(), InlineTrainer() if trainer is None else trainer)


@pytest.fixture(scope="module")
def frames():
    """Eight seconds of breath, made once: a test needs many frames, and the camera is not what is tested."""
    return [scene.frame(index) for index in range(240)]


class Played:
    """Frames one after the other, again and again, each with the time it would have."""

    def __init__(self, frames):
        self.frames, self.index, self.phase = frames, 0, 0

    def __next__(self):
        self.phase += 1
        return self.stamped(self.frames[(self.phase - 1) % len(self.frames)])

    def held(self, seed):
        """The patient as in the frame before, holding the breath."""
        return self.stamped(scene.frame(seed, excursion=scene.breath((self.phase - 1) % len(self.frames))))

    def stamped(self, shown):
        index = self.index
        self.index += 1
        return replace(
            shown,
            index=index,
            device_index=index + 1,
            timestamp_us=index * scene.FRAME_US,
            color_timestamp_us=index * scene.FRAME_US,
            received_ns=index * scene.FRAME_US * 1000,
        )


@pytest.fixture(scope="module")
def learned(frames):
    pipeline, camera = new_pipeline(), Played(frames)
    while pipeline.model is None:
        pipeline.measure(next(camera))
    return pipeline.model


def measuring(learned, frames, trainer=None):
    """A pipeline that measures, and the camera it looks through."""
    pipeline, camera = new_pipeline(trainer), Played(frames)
    pipeline.activate(learned)
    while pipeline.measure(next(camera)).state is not MeasurementState.MEASURING:
        assert camera.index < 400
    return pipeline, camera


def test_the_whole_signal_steps_by_less_than_0_05_mm_at_a_swap_of_a_steady_phantom(learned, frames):
    pipeline, camera = measuring(learned, frames)
    steps = []
    for _ in range(3):
        first = pipeline.model
        pipeline.retrain()
        pipeline.keep_model(is_kept=True)
        while not pipeline.is_model_waiting:
            assert camera.index < 3000
            assert pipeline.measure(next(camera)).state is MeasurementState.MEASURING
        held = [camera.held(5000 + number) for number in range(60)]
        before = [pipeline.measure(frame).motion.whole_mm for frame in held[:30]]
        pipeline.keep_model(is_kept=False)
        after = [pipeline.measure(frame).motion.whole_mm for frame in held[30:]]
        assert pipeline.model is not first
        steps.append(np.mean(after) - np.mean(before))
    assert np.abs(steps).max() < 0.05


def test_a_sheet_that_lies_on_the_patient_is_not_learned_behind_the_zero_s_back(learned, frames):
    pipeline, camera = measuring(learned, frames)
    first = pipeline.model
    covered = []
    for shown in frames:
        depth = shown.depth_mm.copy()
        depth[110:380, 230:318] -= 4  # over one side: thin enough to be explained, were it not for how it came
        covered.append(scene.frame(shown.index, edit=lambda target, depth=depth: np.copyto(target, depth)))
    sheet = Played(covered)
    for _ in range(30):
        pipeline.measure(next(camera))
    sheet.index = camera.index
    sheet.phase = camera.phase
    lost = [pipeline.measure(next(sheet)).state for _ in range(10)]
    pipeline.retrain()
    lost += [pipeline.measure(next(sheet)).state for _ in range(300)]
    assert set(lost[3:]) == {MeasurementState.LOST}
    assert pipeline.model is first
    assert not [notice for notice in pipeline.take_notices() if notice.kind is NoticeKind.READY]


def test_a_stored_model_is_measured_with_and_accepted_on_the_same_patient(learned, frames):
    pipeline, camera = new_pipeline(), Played(frames)
    pipeline.resume(learned)
    while pipeline.likeness is None:
        last = pipeline.measure(next(camera))
        assert camera.index < 400
    assert pipeline.likeness.refusal is None
    assert pipeline.likeness.distance_mm < 5.0
    assert pipeline.likeness.shape_mm < 1.0
    assert last.state is MeasurementState.MEASURING
    assert pipeline.model is not None
    assert not pipeline.has_reference


class Camera:
    """A source that hands frames over as fast as they are taken, until it is told to end."""

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


def test_no_frame_is_lost_while_models_are_learned_and_swapped_in_real_threads(frames, learned):
    """Counted: as many measurements as frames, in order, all of them measured, through two retrainings."""
    clock = MonotonicClock()
    camera = Camera(frames, clock)
    pipeline = Pipeline(scene.CALIBRATION, SETTINGS, clock, BackgroundTrainer())
    pipeline.activate(learned)
    loop = EngineLoop(
        source=camera,
        pipeline=pipeline,
        beam=SimulatedBeamLine(clock),
        limits=PATIENT_LIMITS,
        clock=clock,
        sample_capacity=100_000,
    )
    records, kinds, asked = [], [], 0
    loop.start()
    while kinds.count(NoticeKind.SWAPPED) < 3:
        records.append(loop.samples.get(timeout=60.0))
        while True:
            try:
                kinds.append(loop.notices.get_nowait().kind)
            except queue.Empty:
                break
        if kinds.count(NoticeKind.SWAPPED) > asked:
            asked += 1
            loop.submit(Retrain(operator="ann")).result(timeout=60.0)
        assert not loop.status.is_over, loop.error
    camera.end.set()
    assert loop.join(60.0)
    while not loop.samples.empty():
        records.append(loop.samples.get_nowait())
    indices = [record.measurement.frame_index for record in records]
    assert indices == list(range(camera.given))
    states = [record.measurement.state for record in records]
    first = states.index(MeasurementState.MEASURING)
    assert set(states[first:]) == {MeasurementState.MEASURING}
    assert kinds.count(NoticeKind.READY) == 2
