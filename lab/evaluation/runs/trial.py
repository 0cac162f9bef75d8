"""Measures one recording with every method: the plain method, Tidegate, the oracle.

Every frame is decoded once and passed to all methods.
"""

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from engine.calibration.camera_calibration import Calibration, load_calibration
from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray, Measurement, MeasurementState, Motion, RgbdFrame
from engine.core.motion_model import MotionModel
from engine.core.native_process import keep_calls_in_their_thread
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.measure import measure_recording
from engine.offline.result_files import OfflineSummary, fingerprint
from lab.evaluation.instruments.instruments import LaserSide, add_spirometer
from lab.evaluation.methods.oracle import FIELDS, Oracle, true_modes
from lab.evaluation.methods.outcome import COEFFICIENTS, LOST, MEASURING, TRAINING, Outcome, Track
from lab.evaluation.methods.plain import (
    TRAINING_FRAMES,
    PlainFrame,
    PlainModel,
    PlainReading,
    PlainVolume,
    fill_zeros,
    smooth,
    unfiltered,
)
from lab.evaluation.methods.smoothed import SmoothedPca
from lab.evaluation.playback import decoded_frames
from lab.evaluation.runs.datasets import Run
from lab.phantom.recording import load_truth
from lab.phantom.scene import Scene, Script
from lab.phantom.truth import CELL_PX, POINTS_RC, Truth

EIGENVALUES = 10
MODEL_FILE = "model.npz"
MEASURING_SOURCES = (
    "engine/core/**/*.py",
    "engine/calibration/*.py",
    "engine/capture/*.py",
    "engine/capture/oni/*.py",
    "engine/gating/**/*.py",
    "engine/motion/**/*.py",
    "engine/offline/*.py",
    "lab/evaluation/instruments/*.py",
    "lab/evaluation/methods/*.py",
    "lab/evaluation/playback.py",
    "lab/evaluation/runs/trial.py",
)
"""Sources that a cached measurement depends on: globs of `fingerprint`."""

GATE = GateLimits(window=amplitude_window(lower_mm=-1.0, upper_mm=1.0))
"""Default limits of the frame checks; the window is not used."""

_STATES = {
    MeasurementState.TRAINING: TRAINING,
    MeasurementState.MEASURING: MEASURING,
    MeasurementState.LOST: LOST,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialSettings:
    """Training settings of each method."""

    plain_frames: int = TRAINING_FRAMES
    training: TrainingSettings = field(default_factory=TrainingSettings)

    def pipeline(self, components: int | None = None) -> PipelineSettings:
        """Return Tidegate's settings: cells of 10 px, the truth's five points, and by default its own components."""
        training = self.training
        return PipelineSettings(
            cell_px=CELL_PX,
            points=tuple((int(row), int(column)) for row, column in POINTS_RC),
            training=TrainingSettings(
                min_frames=training.min_frames,
                min_cycles=training.min_cycles,
                min_seconds=training.min_seconds,
                max_seconds=training.max_seconds,
                max_frames=training.max_frames,
                components=training.components if components is None else components,
            ),
        )


def recipe_of(run: Run) -> dict[str, object]:
    """Return all that a run's ``measured.npz`` depends on: the recording's recipe and the measuring code."""
    return {
        **run.recipe,
        "code": fingerprint(*MEASURING_SOURCES),
        "is_long": run.is_long,
        "is_pictured": run.is_pictured,
    }


def measure_run(
    run: Run,
    folder: Path,
    *,
    settings: TrialSettings | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> Outcome:
    """Measure a run's recording with every method.

    Parameters
    ----------
    folder
        Folder of its recording, calibration and truth.
    on_frame
        Called with the number of frames measured so far.
    """
    keep_calls_in_their_thread()
    truth = load_truth(folder / "truth.npz")
    calibration = load_calibration(folder / "calibration.json")
    chosen = settings or TrialSettings()
    laser = LaserSide(calibration, folder) if run.has_laser else None
    trial = _Trial(run, calibration, truth, chosen, laser)
    source = OniFileSource(folder / "recording.oni", clock=ManualClock(), is_helped=False)
    for frame in decoded_frames(source):
        trial.add_frame(frame)
        if on_frame is not None:
            on_frame(frame.index + 1)
    outcome = trial.outcome()
    if run.is_measured_whole:
        found = measured_whole(folder, calibration, chosen.pipeline(), len(truth.timestamp_us))
        outcome.tracks["offline"], summary = found
        outcome.notes["segments"] = [{"first_frame": one.first_frame, "cause": one.cause} for one in summary.segments]
    if not run.is_sweep:
        lag_s = truth.spirometer_lag_s
        add_spirometer(outcome, folder, None if lag_s is None else float(lag_s))
    return outcome


def measured_whole(
    folder: Path, calibration: Calibration, settings: PipelineSettings, frames: int, model: MotionModel | None = None
) -> tuple[Track, OfflineSummary]:
    """Measure a recording as `tidegate measure` does: every frame, by a model of all of it or by a stored one.

    Returns what was measured, and its summary. The model that measured is written to ``model.npz`` of the folder,
    unless it was given.
    """
    track, passes = Track.empty(frames), [0]

    def keep(measurement: Measurement) -> None:
        if passes[0] == 2 and measurement.motion is not None:
            _write(track, measurement.frame_index, measurement.motion)

    source = OniFileSource(folder / "recording.oni", clock=ManualClock(), is_helped=False)
    with tempfile.TemporaryDirectory() as out:
        summary = measure_recording(
            source,
            calibration,
            Path(out),
            settings=settings,
            on_frame=keep,
            on_pass=lambda number: passes.__setitem__(0, number),
            model=model,
        )
        if model is None:
            shutil.copy(Path(out) / MODEL_FILE, folder)
    return track, summary


def _write(track: Track, index: int, motion: Motion) -> None:
    beta = motion.projection.beta
    track.cells_mm[index] = motion.regions_mm
    track.wide_mm[index] = (motion.whole_mm, motion.thorax_mm, motion.abdomen_mm)
    track.points_mm[index] = motion.points_mm
    track.volume_l[index] = motion.volume_l
    track.beta[index, : len(beta)] = beta[:COEFFICIENTS]


class _Trial:
    def __init__(
        self, run: Run, calibration: Calibration, truth: Truth, settings: TrialSettings, laser: LaserSide | None
    ) -> None:
        n = len(truth.timestamp_us)
        self._truth, self._laser = truth, laser
        self._ours = TidegateSide(calibration, settings.pipeline(), n)
        self._one_component = TidegateSide(calibration, settings.pipeline(1), n) if run.is_long else None
        self._plain = _PlainSide(run, calibration, settings, n)
        self._lowered_mm = np.array([run.lowered_mm(time_s) for time_s in truth.timestamp_us * 1e-6])
        # The oracle knows where the patient lies, not where the couch went.
        self._oracle = None if run.is_lowered else _OracleSide(run, truth)
        self._smoothed = SmoothedPca(calibration, settings.pipeline(), n) if run.is_measured_whole else None
        self._is_pictured = run.is_pictured
        self._pictures: dict[str, FloatArray] = {}

    def add_frame(self, frame: RgbdFrame) -> None:
        measured = self._ours.add_frame(frame)
        if self._one_component is not None:
            self._one_component.add_frame(frame)
        if self._laser is not None:
            self._laser.add_frame(frame, measured)
        if self._smoothed is not None:
            self._smoothed.add_frame(frame)
        plain = self._plain.add_frame(frame)
        # The oracle uses our reference frame, so that both have the same frame's noise in their errors.
        if self._oracle is not None:
            self._oracle.add_frame(frame, is_learning=self._ours.track.reference is None)
        if self._is_pictured and plain is not None and frame.index in self._truth.full_index:
            self._pictures = _pictures(plain, self._plain.reading, measured, self._ours.pipeline)
            if self._pictures:
                kept = int(np.flatnonzero(self._truth.full_index == frame.index)[0])
                self._pictures["truth"] = self._truth.full_depth_mm[kept]

    def outcome(self) -> Outcome:
        tracks = {"ours": self._ours.track, **self._plain.tracks}
        if self._oracle is not None:
            tracks["oracle"] = self._oracle.track
        if self._one_component is not None:
            tracks["ours1"] = self._one_component.track
        if self._smoothed is not None:
            tracks["smoothed"] = self._smoothed.track()
        # Before the tracks are converted from depth to motion.
        instruments = {} if self._laser is None else self._laser.compare(tracks["plain"].cells_mm)
        for name, track in tracks.items():
            if name not in {"ours", "ours1"}:  # which speaks of motion already
                track.finish()
        ours = self._ours
        return Outcome(
            timestamp_us=self._truth.timestamp_us,
            truth=_true_track(self._truth, self._lowered_mm),
            tracks=tracks,
            state=ours.state,
            residual_mm=ours.residual_mm,
            valid_share=ours.valid_share,
            is_trusted=ours.is_trusted,
            spectra=self._plain.spectrum() | ours.spectrum(),
            pictures=self._pictures,
            instruments=instruments,
            notes={**ours.notes(), "oracle_modes": 0 if self._oracle is None else len(self._oracle.oracle.modes.modes)},
            events=json.loads(self._truth.labels)["events"],
        )


class TidegateSide:
    """Tidegate's pipeline, unmodified."""

    def __init__(self, calibration: Calibration, settings: PipelineSettings, frames: int) -> None:
        self.pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
        self.track = Track.empty(frames)
        self.state = np.zeros(frames, dtype=np.int8)
        self.residual_mm, self.valid_share = np.full(frames, np.nan), np.full(frames, np.nan)
        self.is_trusted = np.zeros(frames, dtype=np.bool_)
        self._reasons: Counter[str] = Counter()

    def add_frame(self, frame: RgbdFrame) -> Measurement:
        """Measure the next frame, and keep what was measured."""
        measurement = self.pipeline.measure(frame)
        self.state[frame.index] = _STATES[measurement.state]
        if measurement.reason is not None:
            self._reasons[measurement.reason.reason.value] += 1
        if measurement.motion is not None:
            self._write(frame.index, measurement.motion)
        return measurement

    def _write(self, index: int, motion: Motion) -> None:
        fit = motion.projection
        _write(self.track, index, motion)
        self.residual_mm[index], self.valid_share[index] = fit.residual_mm, fit.valid_share
        self.is_trusted[index] = (
            fit.residual_mm <= GATE.max_residual_mm
            and fit.valid_share >= GATE.min_valid_share
            and fit.inlier_share >= GATE.min_inlier_share
        )

    def spectrum(self) -> dict[str, FloatArray]:
        """Return the model's spectrum by name; empty without a model."""
        model = self.pipeline.learner.status.model
        return {} if model is None else {"ours": model.spectrum[:EIGENVALUES].copy()}

    def notes(self) -> dict[str, object]:
        """Return why frames were lost, and what the model learned from."""
        model = self.pipeline.learner.status.model
        learned = {} if model is None else {"training_frames": model.training_frames, "cycles": model.cycles}
        return {"lost": dict(self._reasons), **learned}


class _PlainSide:
    """The plain method; if the run wants it, also with one component and with the bilateral filter alone."""

    def __init__(self, run: Run, calibration: Calibration, settings: TrialSettings, frames: int) -> None:
        self.reading = PlainReading(calibration, run.fps, training_frames=settings.plain_frames)
        self._volume = PlainVolume(calibration)
        names = ["plain", *(["plain1"] if run.is_long else []), *(["bilateral"] if run.is_pictured else [])]
        self.tracks = {name: Track.empty(frames) for name in names}

    def add_frame(self, frame: RgbdFrame) -> PlainFrame | None:
        measured, model = self.reading.measure(frame), self.reading.model
        if measured is None or model is None:
            return None
        surface = model.reconstruct(measured.beta)
        track = self.tracks["plain"]
        track.set_surface(frame.index, surface)
        track.volume_l[frame.index] = self._volume.above_first_l(surface, measured.dots_px)
        track.beta[frame.index] = measured.beta
        if "plain1" in self.tracks:
            self.tracks["plain1"].set_surface(frame.index, model.reconstruct(measured.beta, 1))
        if "bilateral" in self.tracks:
            self.tracks["bilateral"].set_surface(frame.index, _only_filtered(measured, model))
        return measured

    def spectrum(self) -> dict[str, FloatArray]:
        if self.reading.model is None:
            return {}
        eigenvalues = self.reading.model.eigenvalues_mm2
        return {"plain": eigenvalues[:EIGENVALUES] / max(float(eigenvalues.sum()), 1e-9)}


class _OracleSide:
    def __init__(self, run: Run, truth: Truth) -> None:
        self._truth = truth
        scene = Scene(
            Script(
                scenario=run.scenario,
                volunteer=run.volunteer,
                seconds=float(run.seconds),
                fps=float(run.fps),
                seed=run.seed,
                departure=run.departure,
            )
        )
        seconds = truth.timestamp_us * 1e-6
        self.oracle = Oracle(scene, true_modes(scene, np.linspace(seconds[0], seconds[-1], FIELDS)))
        self.track = Track.empty(len(seconds))

    def add_frame(self, frame: RgbdFrame, *, is_learning: bool) -> None:
        i = frame.index
        known = (frame.depth_mm, self._truth.depth_markers_px[i], self._truth.cell_depth_mm[i])
        if is_learning:
            self.oracle.calibrate(*known)
            return
        surface = self.oracle.measure(*known)
        if surface is not None:
            self.track.set_surface(i, surface)


def _only_filtered(measured: PlainFrame, model: PlainModel) -> FloatArray:
    """Apply hole filling and the bilateral filter without PCA; remaining zeros add_frame the mean frame's depth."""
    surface = smooth(fill_zeros(measured.roi_mm))
    return np.where(surface == 0, model.mean_mm.reshape(surface.shape), surface)


def _pictures(
    plain: PlainFrame, reading: PlainReading, measurement: Measurement, pipeline: Pipeline
) -> dict[str, FloatArray]:
    """Return Figure 8's pictures: components and reconstructions with and without filtering, and ours."""
    grid = (ROI_ROWS, ROI_COLUMNS)
    if reading.model is None or pipeline.learner.status.model is None or measurement.motion is None:
        return {}
    wrong = unfiltered(reading.raw_mm)
    frame = plain.roi_mm.ravel()
    beta = wrong.components @ (frame - wrong.mean_mm)
    ours = measurement.motion.projection.beta
    return {
        "frame": plain.roi_mm,
        "unfiltered_component": wrong.components[0].reshape(grid),
        "unfiltered": wrong.reconstruct(beta),
        "plain_component": reading.model.components[0].reshape(grid),
        "plain": reading.model.reconstruct(plain.beta),
        "ours_component": pipeline.learner.status.model.components[0],
        "ours": pipeline.learner.status.model.reconstruct(ours),
    }


def _true_track(truth: Truth, lowered_mm: FloatArray) -> Track:
    """Convert the truth to a track of depth [mm]; the couch is ``lowered_mm`` below where it was, shape (n,)."""
    track = Track.empty(len(truth.timestamp_us))
    track.cells_mm[:] = truth.cell_depth_mm + lowered_mm[:, None, None]
    track.wide_mm[:] = np.column_stack([truth.whole_depth_mm, truth.thorax_depth_mm, truth.abdomen_depth_mm])
    track.wide_mm += lowered_mm[:, None]
    track.points_mm[:] = truth.point_depth_mm + lowered_mm[:, None]
    track.volume_l[:] = truth.volume_l
    return track
