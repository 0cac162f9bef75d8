"""Ablation study: the same recordings measured with one part of the method changed at a time.

A part is changed by patching its module while that variant's pipeline measures, so the product needs no switches for
it. Every frame is decoded once for all variants.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from engine.calibration.camera_calibration import load_calibration
from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.errors import InvalidValueError
from engine.core.frames import BoolArray, FloatArray, RoiDepth
from engine.core.motion_model import MotionModel
from engine.core.native_process import keep_calls_in_their_thread
from engine.motion.learning import fitting
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.motion.stages.preprocessing import fill_holes, smooth_bilateral
from lab.evaluation.playback import decoded_frames
from lab.evaluation.runs.datasets import Run, full_plan, make_dataset
from lab.evaluation.table import Cell, Table
from lab.phantom.sensor import USUAL, find_sensor
from lab.phantom.truth import CELL_PX, load_truth

RUNS = ("D02", "I03", "S01", "H01", "V01")
Patches = Mapping[tuple[str, str], object]
PROJECTION = "engine.motion.stages.projection"
COMPONENTS = "engine.motion.learning.principal_components"
SMOOTHING = "engine.motion.learning.shape_smoothing"


def _filtered_fit(depth_mm: FloatArray, valid: BoolArray, **settings: object) -> MotionModel:
    """Fit as in the article: fill holes and smooth the frames with the bilateral filter first."""
    ready = [
        smooth_bilateral(fill_holes(RoiDepth(depth_mm=depth.copy(), valid=seen.copy())))
        for depth, seen in zip(depth_mm, valid, strict=True)
    ]
    depth, seen = np.stack([roi.depth_mm for roi in ready]), np.stack([roi.valid for roi in ready])
    learn: Callable[..., MotionModel] = fitting.fit
    return learn(depth, seen, **settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """The method with one part changed: patched values by (module, name)."""

    name: str
    patches: Patches = field(default_factory=dict)
    components: int = TrainingSettings().components

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Apply the patches inside the block and undo them after it."""
        with ExitStack() as stack:
            for (module, name), value in self.patches.items():
                stack.enter_context(patch.object(importlib.import_module(module), name, value))
            yield


VARIANTS = (
    Variant(name="as shipped"),
    Variant(
        name="readings without undoing the depth steps",
        patches={("engine.motion.tracking.region_tracker", "find_steps"): lambda _: None},
    ),
    Variant(
        name="components smoothed by 4 px only",
        patches={(SMOOTHING, "kept_shares"): lambda total, _: np.ones_like(total, dtype=np.float32)},
    ),
    Variant(
        name="components smoothed by 32 px",
        patches={(SMOOTHING, "kept_shares"): lambda total, _: np.zeros_like(total, dtype=np.float32)},
    ),
    Variant(name="pixel locking not estimated", patches={(SMOOTHING, "CAUTION"): 0.0}),
    Variant(name="modes with the noise of 24 px squares", patches={(PROJECTION, "NOISE_OF_MODES"): 1.0}),
    Variant(
        name="training frames through the bilateral filter",
        patches={("engine.motion.learning.tasks", "fit"): _filtered_fit},
    ),
    Variant(name="components alone, no cosines", patches={(PROJECTION, "PRIOR_SPREADS_MM"): (1e-3,)}),
    Variant(name="cosines under one wide prior", patches={(PROJECTION, "PRIOR_SPREADS_MM"): (3.0,)}),
    Variant(
        name="40 cosines instead of 24",
        patches={(PROJECTION, "COSINE_ROWS"): 8, (PROJECTION, "COSINE_COLUMNS"): 5},
    ),
    Variant(
        name="reference from a single frame",
        patches={("engine.motion.learning.reference_transfer", "MIN_FRAMES"): 1000},
    ),
    Variant(name="one component", components=1),
    Variant(name="three components in any case", patches={(COMPONENTS, "MIN_OVER_NOISE"): 0.0}, components=3),
    Variant(name="six components in any case", patches={(COMPONENTS, "MIN_OVER_NOISE"): 0.0}),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ablation:
    """Error of every variant on one run over cells of 10 px [mm]: mean, and mean of the worst frame."""

    run: Run
    mean_mm: tuple[float, ...]
    worst_mm: tuple[float, ...]


def runs(seed: int, sensor: str = USUAL, scenarios: tuple[str, ...] = ()) -> list[Run]:
    """Return one run of each scenario, recorded by one sensor model, or only those of some scenarios.

    Raises
    ------
    InvalidValueError
        The sensor model or a scenario is unknown; names field, value and bound.
    """
    find_sensor(sensor)
    planned = {run.name: run for run in full_plan(seed)}
    chosen = {run.scenario: run for run in (*(planned[name] for name in RUNS), _drift(seed))}
    for scenario in scenarios:
        if scenario not in chosen:
            raise InvalidValueError("scenario", scenario, "one of " + ", ".join(chosen))
    wanted = [run for name, run in chosen.items() if name in (scenarios or chosen)]
    if sensor == USUAL:
        return wanted
    return [replace(run, name=f"{run.name}-{sensor}", sensor=sensor) for run in wanted]


def _drift(seed: int) -> Run:
    return Run(name="B01", group="drift", scenario="drift", volunteer=1, seed=seed + 120, seconds=40.0)


def ablate(run: Run, folder: Path, on_frame: Callable[[int], None]) -> Ablation:
    """Make a run's recording if it is missing, and measure it with every variant.

    Parameters
    ----------
    on_frame
        Called with the number of frames measured so far.
    """
    keep_calls_in_their_thread()
    make_dataset(run, folder, lambda _done, _total: None)
    truth, calibration = load_truth(folder / "truth.npz"), load_calibration(folder / "calibration.json")
    pipelines = []
    for variant in VARIANTS:
        settings = PipelineSettings(cell_px=CELL_PX, training=TrainingSettings(components=variant.components))
        with variant.applied():
            pipelines.append(Pipeline(calibration, settings, ManualClock(), InlineTrainer()))
    shape = (len(VARIANTS), *truth.cell_depth_mm.shape)
    motion_mm = np.full(shape, np.nan, dtype=np.float32)
    source = OniFileSource(folder / "recording.oni", clock=ManualClock(), is_helped=False)
    for frame in decoded_frames(source):
        for number, (variant, pipeline) in enumerate(zip(VARIANTS, pipelines, strict=True)):
            with variant.applied():
                motion = pipeline.measure(frame).motion
            if motion is not None:
                motion_mm[number, frame.index] = motion.regions_mm
        on_frame(frame.index + 1)
    errors = [_errors_mm(motion, truth.cell_depth_mm) for motion in motion_mm]
    return Ablation(
        run=run,
        mean_mm=tuple(float(np.nanmean(error)) for error in errors),
        worst_mm=tuple(float(np.nanmax(error)) for error in errors),
    )


def table(ablations: list[Ablation]) -> Table:
    """Return the table of variants (rows) and runs (columns)."""
    rows: list[tuple[Cell, ...]] = []
    for number, variant in enumerate(VARIANTS):
        cells: list[Cell] = [variant.name]
        for ablation in ablations:
            cells += [ablation.mean_mm[number], ablation.worst_mm[number]]
        rows.append(tuple(cells))
    headings = [f"{ablation.run.scenario}{part}" for ablation in ablations for part in ("", ", worst frame")]
    return Table(
        name="ablations",
        title="Ablations: error over cells of 10 px [mm], the reference frame's error included",
        columns=("variant", *headings),
        rows=tuple(rows),
        note="One part changed at a time, the same recordings for all.",
        digits=3,
    )


def _errors_mm(motion_mm: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Mean error over the cells of each measured frame [mm], relative to the first measured one."""
    measured = np.flatnonzero(np.isfinite(motion_mm).any(axis=(1, 2)))
    true_mm = depth_mm[measured[0]] - depth_mm[measured]
    return np.asarray(np.nanmean(np.abs(motion_mm[measured] - true_mm), axis=(1, 2)))
