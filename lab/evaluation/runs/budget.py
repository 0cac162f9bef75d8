"""Error budget: the same breathing measured with one cause of error at a time replaced by the truth.

The sensor's errors are left out of the recording one at a time, and all at once. The model of the perfect recording
measures the real one (components of the truth), the real one's model the perfect recording (coefficients of the truth),
and the markers are put where they are (registration of the truth).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from engine.calibration.camera_calibration import load_calibration
from engine.core.frames import FloatArray, Markers, RgbdFrame
from engine.core.native_process import keep_calls_in_their_thread
from engine.motion.learning.model_file import load_model
from engine.motion.tracking.region_tracker import RegionTracker
from lab.evaluation.runs.datasets import Run, accuracy_plan, make_dataset
from lab.evaluation.runs.scores import cell_errors_mm
from lab.evaluation.runs.trial import MODEL_FILE, TrialSettings, measured_whole
from lab.evaluation.table import Cell, Table
from lab.phantom.recording import load_truth
from lab.phantom.sensor import ERRORS
from lab.phantom.truth import Truth

RECORDED, PERFECT = "as recorded", "no error of the sensor"
TRUE_COMPONENTS = "model of the perfect recording"
TRUE_COEFFICIENTS = "this model on the perfect recording"
TRUE_MARKERS = "markers where they are"
ROWS = (RECORDED, *(f"no {error}" for error in ERRORS), PERFECT, TRUE_COMPONENTS, TRUE_COEFFICIENTS, TRUE_MARKERS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Errors of one run by cause, in the order of `ROWS`: of the cells, with constants out, and with gains out [mm]."""

    run: Run
    errors_mm: tuple[tuple[float, float, float], ...]


def runs(seed: int, sensor: str, scenarios: tuple[str, ...] = ()) -> list[Run]:
    """Return one run of each scenario, or of those named, that is measured whole on this sensor."""
    chosen: dict[str, Run] = {}
    for run in sorted(accuracy_plan(seed, sensor=sensor), key=lambda run: run.name):
        if not run.is_lowered and (not scenarios or run.scenario in scenarios):
            chosen.setdefault(run.scenario, replace(run, has_instruments=False))
    return list(chosen.values())


def split(run: Run, folder: Path, on_row: Callable[[int], None]) -> Budget:
    """Make the run's recordings where they are missing, and measure each; ``on_row`` is called with the rows done."""
    keep_calls_in_their_thread()
    errors_mm: list[tuple[float, float, float]] = []

    def add(of: str, model: Path | None = None) -> None:
        errors_mm.append(_errors_mm(folder / of, model))
        on_row(len(errors_mm))

    left_out = {RECORDED: (), **{f"no {error}": (error,) for error in ERRORS}, PERFECT: tuple(ERRORS)}
    for row, errors in left_out.items():
        name = f"{run.sensor} without {', '.join(errors)}" if errors else run.sensor
        make_dataset(replace(run, sensor=name), folder / row, lambda _done, _total: None)
        add(row)
    add(RECORDED, folder / PERFECT / MODEL_FILE)
    add(PERFECT, folder / RECORDED / MODEL_FILE)
    with _true_markers(load_truth(folder / RECORDED / "truth.npz")):
        add(RECORDED)
    return Budget(run=run, errors_mm=tuple(errors_mm))


def table(budgets: list[Budget]) -> Table:
    """Return the table of causes (rows) and runs (columns)."""
    rows: list[tuple[Cell, ...]] = [
        (name, *(value for budget in budgets for value in budget.errors_mm[number])) for number, name in enumerate(ROWS)
    ]
    parts = ("", ", constants out", ", gains out")
    return Table(
        name="budget",
        title="Error budget: recordings measured whole, cells of 10 px [mm]",
        columns=("cause", *(f"{budget.run.scenario}{part}" for budget in budgets for part in parts)),
        rows=tuple(rows),
        digits=3,
        note="One cause at a time replaced by the truth. Constants out: without each cell's mean error, its share of "
        "the reference. Gains out: also without what is proportional to its motion.",
    )


def _errors_mm(folder: Path, model: Path | None) -> tuple[float, float, float]:
    truth = load_truth(folder / "truth.npz")
    calibration = load_calibration(folder / "calibration.json")
    # A model of another sensor's recording: the steps of its readings are not compared.
    stored = None if model is None else replace(load_model(model), depth_steps=None)
    track, _ = measured_whole(folder, calibration, TrialSettings().pipeline(), len(truth.timestamp_us), stored)
    first, frames = track.reference, track.is_measured
    true_mm: FloatArray = truth.cell_depth_mm[0 if first is None else first] - truth.cell_depth_mm
    return cell_errors_mm((track.cells_mm - true_mm)[frames], truth.cell_depth_mm[frames])


@contextmanager
def _true_markers(truth: Truth) -> Iterator[None]:
    def seen(_tracker: RegionTracker, frame: RgbdFrame, _search: object) -> Markers:
        at = int(np.argmin(np.abs(truth.color_timestamp_us - frame.color_timestamp_us)))
        return Markers(centers_px=truth.markers_px[at])

    with patch.object(RegionTracker, "_seen", seen):
        yield
