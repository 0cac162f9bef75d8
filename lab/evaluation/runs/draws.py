"""Sensors drawn from the ranges between cameras: the same breathing on each, with and without the locking curve.

What a method is worth must not hang on the one sensor that it was made with. The draws that are printed are other ones
than those that were used while developing (100 and above).
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from engine.calibration.camera_calibration import load_calibration
from engine.core.native_process import keep_calls_in_their_thread
from lab.evaluation.runs.datasets import Run, accuracy_plan, make_dataset
from lab.evaluation.runs.scores import cell_errors_mm, cell_gains
from lab.evaluation.runs.trial import TrialSettings, measured_whole
from lab.evaluation.table import Cell, Table
from lab.phantom.recording import load_truth
from lab.phantom.sensor import DRAWN

FIND = "engine.motion.learning.fitting.find_locking"


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnErrors:
    """One recording measured whole, first with the curve left on: mean error, without constants [mm], sd of gains."""

    run: Run
    left_on: tuple[float, float, float]
    taken_off: tuple[float, float, float]


def runs(seed: int, first: int, draws: int, scenarios: tuple[str, ...]) -> list[Run]:
    """Return one run of each scenario on each drawn sensor."""
    planned = []
    for number in range(first, first + draws):
        chosen = {run.scenario: run for run in reversed(accuracy_plan(seed, sensor=f"{DRAWN}{number}"))}
        planned += [replace(chosen[scenario], has_instruments=False) for scenario in scenarios]
    return planned


def measure(run: Run, folder: Path) -> DrawnErrors:
    """Make a run's recording where it is missing, and measure it with the curve left on and taken off."""
    keep_calls_in_their_thread()
    make_dataset(run, folder, lambda _done, _total: None)
    with patch(FIND, return_value=None):
        left_on = _errors(folder)
    return DrawnErrors(run=run, left_on=left_on, taken_off=_errors(folder))


def measure_all(planned: list[Run], work: Path, jobs: int) -> list[DrawnErrors]:
    """Measure all runs, in several processes."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(measure, planned, [work / run.name for run in planned]))


def table(found: list[DrawnErrors]) -> Table:
    """Return one row a recording, and mean and worst of each kind of breathing."""
    rows: list[tuple[Cell, ...]] = []
    for scenario in dict.fromkeys(one.run.scenario for one in found):
        of_kind = [one for one in found if one.run.scenario == scenario]
        numbers = np.array([(*one.left_on, *one.taken_off) for one in of_kind])
        rows += [(one.run.sensor, scenario, *row) for one, row in zip(of_kind, numbers.tolist(), strict=True)]
        rows += [("mean", scenario, *numbers.mean(axis=0).tolist()), ("worst", scenario, *numbers.max(axis=0).tolist())]
    parts = ("error", "constants out", "sd of gains")
    return Table(
        name="draws",
        title="Drawn sensors: recordings measured whole, cells of 10 px [mm; gains as a share]",
        columns=(
            "sensor",
            "breathing",
            *(f"{part}, curve {what}" for what in ("left on", "taken off") for part in parts),
        ),
        rows=tuple(rows),
        digits=3,
        note="The locking curve left on the readings, and taken off. Constants out: without a cell's mean error. The "
        "gain of a cell: its error per true motion.",
    )


def _errors(folder: Path) -> tuple[float, float, float]:
    truth, calibration = load_truth(folder / "truth.npz"), load_calibration(folder / "calibration.json")
    track, _ = measured_whole(folder, calibration, TrialSettings().pipeline(), len(truth.timestamp_us))
    first, frames = track.reference, track.is_measured
    true_mm = truth.cell_depth_mm[0 if first is None else first] - truth.cell_depth_mm
    errors_mm, depth_mm = (track.cells_mm - true_mm)[frames], truth.cell_depth_mm[frames]
    mean_mm, constants_out_mm, _ = cell_errors_mm(errors_mm, depth_mm)
    return mean_mm, constants_out_mm, float(cell_gains(errors_mm, depth_mm).std())
