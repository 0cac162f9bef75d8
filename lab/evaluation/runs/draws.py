"""Sensors drawn from the ranges between cameras: the same breathing measured on each, whole and live.

What a method is worth must not hang on the one sensor that it was made with. The draws that are printed are other ones
than those that were used while developing (100 and above).
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from engine.calibration.camera_calibration import Calibration, load_calibration
from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.frames import BoolArray, FloatArray
from engine.core.native_process import keep_calls_in_their_thread
from lab.evaluation.methods.outcome import Track
from lab.evaluation.methods.smoothed import SmoothedPca
from lab.evaluation.playback import decoded_frames
from lab.evaluation.runs.datasets import Run, accuracy_plan, make_dataset
from lab.evaluation.runs.scores import cell_errors_mm, cell_gains
from lab.evaluation.runs.trial import TidegateSide, TrialSettings, measured_whole
from lab.evaluation.table import Cell, Table
from lab.phantom.recording import load_truth
from lab.phantom.sensor import DRAWN
from lab.phantom.truth import Truth

LONG_S = 110.0
"""Length of a recording that is also judged live [s]: a minute behind the model there are breaths left."""
SETTLED_US = 60_000_000
"""Live measurement is judged so long after its first frame."""
LIVE = "regular"


@dataclass(frozen=True, slots=True)
class DrawnErrors:
    """One recording on one drawn sensor: mean errors over the cells of 10 px [mm].

    Attributes
    ----------
    smoothed_mm, whole_mm
        Of the smoothed PCA of all frames, and of ours (`tidegate measure`).
    constants_out_mm, gain_sd
        Ours without each cell's constant; and the standard deviation of the cells' gains.
    reference_mm, stated_mm
        The reference's share of the error, root mean square over the cells, and what the model states it to be.
    live_mm, settled_mm
        A session's, and ours of the whole recording, from a minute after the session's first measurement; NaN for
        recordings that are too short.
    """

    run: Run
    smoothed_mm: float
    whole_mm: float
    constants_out_mm: float
    gain_sd: float
    reference_mm: float
    stated_mm: float
    live_mm: float
    settled_mm: float


def runs(seed: int, first: int, draws: int, scenarios: tuple[str, ...], long_s: float = LONG_S) -> list[Run]:
    """Return one run of each scenario on each drawn sensor; regular ones are long [s]."""
    planned = []
    for number in range(first, first + draws):
        chosen = {run.scenario: run for run in reversed(accuracy_plan(seed, sensor=f"{DRAWN}{number}"))}
        for scenario in scenarios:
            run = replace(chosen[scenario], has_instruments=False)
            planned.append(replace(run, seconds=long_s) if scenario == LIVE else run)
    return planned


def measure(run: Run, folder: Path) -> DrawnErrors:
    """Make a run's recording where it is missing, and measure it live, whole, and by the smoothed PCA."""
    keep_calls_in_their_thread()
    make_dataset(run, folder, lambda _done, _total: None)
    truth, calibration = load_truth(folder / "truth.npz"), load_calibration(folder / "calibration.json")
    whole, summary = measured_whole(folder, calibration, TrialSettings().pipeline(), len(truth.timestamp_us))
    live, smoothed = _one_by_one(folder, calibration, len(truth.timestamp_us))
    errors_mm, depth_mm = _errors_mm(truth, whole), truth.cell_depth_mm[whole.is_measured]
    whole_mm, constants_out_mm, _ = cell_errors_mm(errors_mm[whole.is_measured], depth_mm)
    settled = live.is_measured & whole.is_measured
    settled &= truth.timestamp_us >= SETTLED_US + truth.timestamp_us[live.reference or 0]
    return DrawnErrors(
        run=run,
        smoothed_mm=float(np.nanmean(np.abs(_errors_mm(truth, smoothed)[smoothed.is_measured]))),
        whole_mm=whole_mm,
        constants_out_mm=constants_out_mm,
        gain_sd=float(cell_gains(errors_mm[whole.is_measured], depth_mm).std()),
        reference_mm=float(np.sqrt(np.nanmean(np.square(errors_mm[whole.is_measured].mean(axis=0))))),
        stated_mm=summary.reference_uncertainty_mm or float("nan"),
        live_mm=_mean_mm(_errors_mm(truth, live), settled),
        settled_mm=_mean_mm(errors_mm, settled),
    )


def measure_all(planned: list[Run], work: Path, jobs: int) -> list[DrawnErrors]:
    """Measure all runs, in several processes."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(measure, planned, [work / run.name for run in planned]))


def table(found: list[DrawnErrors]) -> Table:
    """Return one row a recording, and mean and worst of each kind of breathing."""
    names = [name for name in DrawnErrors.__slots__ if name != "run"]
    rows: list[tuple[Cell, ...]] = []
    for scenario in dict.fromkeys(one.run.scenario for one in found):
        of_kind = [one for one in found if one.run.scenario == scenario]
        numbers = np.array([[getattr(one, name) for name in names] for one in of_kind])
        rows += [(one.run.sensor, scenario, *row) for one, row in zip(of_kind, numbers.tolist(), strict=True)]
        rows += [("mean", scenario, *numbers.mean(axis=0).tolist()), ("worst", scenario, *numbers.max(axis=0).tolist())]
    return Table(
        name="draws",
        title="Drawn sensors: cells of 10 px [mm; gains as a share]",
        columns=(
            "sensor",
            "breathing",
            *("smoothed PCA", "ours, whole", "constants out", "sd of gains"),
            *("reference", "reference, stated", "live after 60 s", "whole after 60 s"),
        ),
        rows=tuple(rows),
        digits=3,
        note="Constants out: without a cell's mean error, whose root mean square over the cells is the reference's. "
        "The gain of a cell: its error per true motion. Live: what a session measures from a minute after its model.",
    )


def _one_by_one(folder: Path, calibration: Calibration, frames: int) -> tuple[Track, Track]:
    """Measure a recording frame by frame as a session does; return that, and the smoothed PCA's track."""
    settings = TrialSettings().pipeline()
    side, smoothed = TidegateSide(calibration, settings, frames), SmoothedPca(calibration, settings, frames)
    for frame in decoded_frames(OniFileSource(folder / "recording.oni", clock=ManualClock(), is_helped=False)):
        side.add_frame(frame)
        smoothed.add_frame(frame)
    found = smoothed.track()
    found.finish()
    return side.track, found


def _errors_mm(truth: Truth, track: Track) -> FloatArray:
    """Measured less true motion of the cells [mm], from the track's own reference, shape (n, rows, columns)."""
    return np.asarray(track.cells_mm - (truth.cell_depth_mm[track.reference or 0] - truth.cell_depth_mm))


def _mean_mm(errors_mm: FloatArray, frames: BoolArray) -> float:
    return float(np.nanmean(np.abs(errors_mm[frames]))) if frames.any() else float("nan")
