"""The constants of the measurement that were chosen by their error, chosen again on one part and judged on the other.

Each constant is measured with other values on recordings of several drawn sensors and kinds of breathing. For each
sensor, and for each kind, the value that is best on all others is chosen, and judged on the one that was left out.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from engine.calibration.camera_calibration import load_calibration
from engine.core.frames import FloatArray
from engine.core.native_process import keep_calls_in_their_thread
from lab.evaluation.runs.ablations import COMPONENTS, PROJECTION, SMOOTHING, Patches, Variant
from lab.evaluation.runs.datasets import Run, make_dataset
from lab.evaluation.runs.trial import TrialSettings, measured_whole
from lab.evaluation.table import Cell, Table
from lab.phantom.recording import load_truth

LOCKING = "engine.motion.learning.locking"


@dataclass(frozen=True, slots=True, kw_only=True)
class Constant:
    """A tuned constant: what it does, and its values; the shipped one is None."""

    name: str
    values: tuple[tuple[str, Patches | None], ...]


def _one(name: str, module: str, *values: object, shipped: object) -> Constant:
    """Return a constant of one name in a module, with its shipped value in its place."""
    every = [(str(value), {(module, name): value}) for value in values]
    return Constant(name=name, values=((str(shipped), None), *every))


CONSTANTS = (
    _one("MIN_OVER_NOISE", COMPONENTS, 1.6, 3.5, shipped=2.3),
    _one("CAUTION", SMOOTHING, 1.3, 5.0, shipped=3.0),
    _one("CERTAINLY_LOCKING", SMOOTHING, 1.35, 1.8, shipped=1.5),
    _one("WIDTHS_PX", SMOOTHING, (9.0, 15.0, 24.0), (16.0, 27.0, 43.0), shipped=(12.0, 20.0, 32.0)),
    Constant(
        name="CHANCE, CERTAIN",
        values=(
            ("5, 7", None),
            ("3.5, 5", {(LOCKING, "CHANCE"): 3.5, (LOCKING, "CERTAIN"): 5.0}),
            ("8, 11", {(LOCKING, "CHANCE"): 8.0, (LOCKING, "CERTAIN"): 11.0}),
        ),
    ),
    _one("PRIOR_SPREADS_MM", PROJECTION, (0.05, 0.25, 1.5), (0.2, 1.0, 6.0), shipped=(0.1, 0.5, 3.0)),
    _one("NOISE_OF_MODES", PROJECTION, 1.0, 2.2, shipped=1.5),
)
"""What was chosen by the error of recordings; bounds of the gate were chosen by what they hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuned:
    """One recording measured with each value of each constant: mean error over the cells of 10 px [mm]."""

    run: Run
    errors_mm: dict[tuple[str, str], float]


def tune(run: Run, folder: Path) -> Tuned:
    """Make a run's recording where it is missing, and measure it whole with every value."""
    keep_calls_in_their_thread()
    make_dataset(run, folder, lambda _done, _total: None)
    shipped_mm = _error_mm(folder)
    errors_mm = {}
    for constant in CONSTANTS:
        for value, patches in constant.values:
            with Variant(name=value, patches=patches or {}).applied():
                errors_mm[constant.name, value] = shipped_mm if patches is None else _error_mm(folder)
    return Tuned(run=run, errors_mm=errors_mm)


def tune_all(planned: list[Run], work: Path, jobs: int) -> list[Tuned]:
    """Measure all runs, in several processes."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(tune, planned, [work / run.name for run in planned]))


def table(found: list[Tuned]) -> Table:
    """Return one row a constant: the error of each value, what is chosen without each part, and that choice's error."""
    rows: list[tuple[Cell, ...]] = []
    for constant in CONSTANTS:
        names = [value for value, _ in constant.values]
        errors_mm = np.array([[one.errors_mm[constant.name, value] for value in names] for one in found])
        parts = ([one.run.sensor for one in found], [one.run.scenario for one in found])
        folds = [_held_out(errors_mm, np.array(part)) for part in parts]
        shown = "; ".join(f"{value}: {mm:.4f}" for value, mm in zip(names, errors_mm.mean(axis=0), strict=True))
        chosen = ("; ".join(names[one] for one in choices) for choices, _ in folds)
        rows.append((constant.name, shown, *chosen, float(errors_mm[:, 0].mean()), *(mm for _, mm in folds)))
    return Table(
        name="tuning",
        title="Tuned constants, chosen again [mm, cells of 10 px]",
        columns=(
            *("constant", "mean error of each value, shipped first", "chosen without each sensor"),
            *("chosen without each kind", "shipped", "chosen, on the sensor left out", "chosen, on the kind left out"),
        ),
        rows=tuple(rows),
        digits=4,
        note=f"Recordings: {', '.join(sorted(one.run.name for one in found))}.",
    )


def _held_out(errors_mm: FloatArray, parts: npt.NDArray[np.str_]) -> tuple[list[int], float]:
    """Choose the best value without each part; return the choices, and their mean error on what was left out."""
    choices, left_out = [], []
    for part in dict.fromkeys(parts.tolist()):
        choice = int(errors_mm[parts != part].mean(axis=0).argmin())
        choices.append(choice)
        left_out += errors_mm[parts == part, choice].tolist()
    return choices, float(np.mean(left_out))


def _error_mm(folder: Path) -> float:
    truth, calibration = load_truth(folder / "truth.npz"), load_calibration(folder / "calibration.json")
    track, _ = measured_whole(folder, calibration, TrialSettings().pipeline(), len(truth.timestamp_us))
    true_mm = truth.cell_depth_mm[track.reference or 0] - truth.cell_depth_mm
    return float(np.nanmean(np.abs((track.cells_mm - true_mm)[track.is_measured])))
