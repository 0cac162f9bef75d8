"""What each part of the method is worth: the same recordings measured with one part changed at a time.

A part is changed by putting another value in its module's place while its pipeline measures, so that the product itself
carries no switches for it. Every frame is decoded once for all variants.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np

from engine import fitting
from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import ManualClock
from engine.evaluation.datasets import Run, full_plan, make_dataset
from engine.evaluation.playing import decoded_frames
from engine.evaluation.tables import Cell, Table
from engine.frames import BoolArray, FloatArray, RoiDepth
from engine.model import MotionModel
from engine.phantom.truth import CELL_PX, load_truth
from engine.pipeline import Pipeline, PipelineSettings
from engine.stages.preprocessing import fill_holes, smooth_bilateral
from engine.threads import keep_calls_in_their_thread
from engine.training import InlineTrainer, TrainingSettings

RUNS = ("D02", "I03", "S01", "H01", "V01")
Patches = Mapping[tuple[str, str], object]


def _filtered_fit(depth_mm: FloatArray, valid: BoolArray, **wanted: object) -> MotionModel:
    """Learn as the article does: holes filled and frames smoothed with the bilateral filter first."""
    ready = [
        smooth_bilateral(fill_holes(RoiDepth(depth_mm=depth.copy(), valid=seen.copy())))
        for depth, seen in zip(depth_mm, valid, strict=True)
    ]
    depth, seen = np.stack([roi.depth_mm for roi in ready]), np.stack([roi.valid for roi in ready])
    learn: Callable[..., MotionModel] = fitting.fit
    return learn(depth, seen, **wanted)


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """The method with one part changed: what stands in a module's place, by (module, name)."""

    name: str
    patches: Patches = field(default_factory=dict)
    components: int = 3

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Put the other values in place, and back."""
        with ExitStack() as stack:
            for (module, name), value in self.patches.items():
                stack.enter_context(patch.object(importlib.import_module(module), name, value))
            yield


_PROJECTION = "engine.stages.projection"
VARIANTS = (
    Variant(name="as shipped"),
    Variant(
        name="readings as they are, steps not undone", patches={("engine.depth_table", "find_steps"): lambda _: None}
    ),
    Variant(name="components smoothed by 4 px only", patches={("engine.fitting", "SMOOTHINGS_PX"): (4.0,)}),
    Variant(name="components smoothed by 48 px", patches={("engine.fitting", "SMOOTHINGS_PX"): (48.0,)}),
    Variant(name="training frames through the bilateral filter", patches={("engine.errands", "fit"): _filtered_fit}),
    Variant(name="components alone, no cosines", patches={(_PROJECTION, "PRIOR_SPREADS_MM"): (1e-3,)}),
    Variant(name="cosines under one wide prior", patches={(_PROJECTION, "PRIOR_SPREADS_MM"): (3.0,)}),
    Variant(
        name="40 cosines instead of 24",
        patches={(_PROJECTION, "COSINE_ROWS"): 8, (_PROJECTION, "COSINE_COLUMNS"): 5},
    ),
    Variant(name="zero from a single frame", patches={("engine.quiet", "MIN_FRAMES"): 1000}),
    Variant(name="every reading believed", patches={(_PROJECTION, "OUTLIER_MM"): 1e4}),
    Variant(name="one component", components=1),
    Variant(name="six components", components=6),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ablation:
    """Error of every variant on one run over cells of 10 px [mm]: the mean, and the worst frame's mean."""

    run: Run
    mean_mm: tuple[float, ...]
    worst_mm: tuple[float, ...]


def runs(seed: int) -> list[Run]:
    """Return a recording each of regular and irregular breathing, a shift, breath holds, an isovolume manoeuvre."""
    planned = {run.name: run for run in full_plan(seed)}
    return [planned[name] for name in RUNS]


def ablate(run: Run, folder: Path, on_frame: Callable[[int], None]) -> Ablation:
    """Make a run's recording if it is not there, and measure it in every variant.

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
    """Lay the runs out side by side."""
    rows: list[tuple[Cell, ...]] = []
    for number, variant in enumerate(VARIANTS):
        cells: list[Cell] = [variant.name]
        for ablation in ablations:
            cells += [ablation.mean_mm[number], ablation.worst_mm[number]]
        rows.append(tuple(cells))
    headings = [f"{ablation.run.scenario}{part}" for ablation in ablations for part in ("", ", worst frame")]
    return Table(
        name="ablations",
        title="What each part is worth: error over cells of 10 px [mm], the reference frame's own error included",
        columns=("variant", *headings),
        rows=tuple(rows),
        note="One part changed at a time, the same recordings for all.",
        digits=3,
    )


def _errors_mm(motion_mm: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Mean error over the cells of every measured frame [mm], against the first measured one."""
    measured = np.flatnonzero(np.isfinite(motion_mm).any(axis=(1, 2)))
    true_mm = depth_mm[measured[0]] - depth_mm[measured]
    return np.asarray(np.nanmean(np.abs(motion_mm[measured] - true_mm), axis=(1, 2)))
