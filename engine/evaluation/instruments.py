"""Laser line and spirometer beside a trial, as in the article's sections 4.5.1 and 4.5.2."""

from pathlib import Path

import numpy as np

from engine.calibration import Calibration
from engine.errors import InvalidValueError
from engine.evaluation.cell_surface import CellSurface
from engine.evaluation.flow_file import read_flow
from engine.evaluation.laser import LaserGauge
from engine.evaluation.outcome import Array, Outcome
from engine.evaluation.spirometer import compare_volumes
from engine.frames import FloatArray, Measurement, RgbdFrame
from engine.laser_plane import load_plane
from engine.phantom.truth import CELL_PX

LINE_SHARES = np.linspace(0.05, 0.95, 37)
"""Places along the line through the ROI: for Figure 13 all of them."""
FIVE = (4, 11, 18, 25, 32)
"""Which of them are the five points of Table 2: 15, 32.5, 50, 67.5 and 85 % along."""
PLANE, FLOW = "plane.json", "flow.csv"


class LaserSide:
    """Reads the laser's line off the frames that Tidegate measures."""

    def __init__(self, calibration: Calibration, folder: Path) -> None:
        plane = load_plane(folder / PLANE)
        self._gauge = LaserGauge(calibration, plane, shares=LINE_SHARES.tolist(), cell_px=CELL_PX)

    def take(self, frame: RgbdFrame, measurement: Measurement) -> None:
        """Take the next frame and what Tidegate made of it."""
        self._gauge.add(frame, measurement)

    def compare(self, plain_depth_mm: FloatArray) -> dict[str, Array]:
        """Set laser, Tidegate and the plain reading beside each other.

        Parameters
        ----------
        plain_depth_mm
            Depth of the cells by the plain reading, shape (n, 35, 20); NaN where it did not measure.

        Returns
        -------
        dict
            ``laser_mm`` and ``laser_ours_mm``: motion of points beside the line, shape (n, 37); ``laser_line_mm`` and
            ``laser_plain_mm``: motion of the line itself at the five, as the laser and as the plain reading has it,
            shape (n, 5).
        """
        found = self._gauge.comparison()
        surface = CellSurface(CELL_PX)
        depth = np.full((len(plain_depth_mm), len(FIVE)), np.nan)
        for number in np.flatnonzero(np.isfinite(plain_depth_mm[:, 0, 0])):
            depth[number] = surface.values(plain_depth_mm[number], found.place_rc[number, FIVE])[0]
        line = found.line_mm[:, FIVE]
        return {
            "laser_mm": found.laser_mm.astype(np.float32),
            "laser_ours_mm": found.tidegate_mm.astype(np.float32),
            "laser_line_mm": _from_first(line, np.isfinite(depth) & np.isfinite(line)),
            "laser_plain_mm": _from_first(-depth, np.isfinite(depth) & np.isfinite(line)),
        }


def add_spirometer(outcome: Outcome, folder: Path, true_lag_s: float | None) -> None:
    """Set every volume beside the spirometer's; what cannot be compared is left out, with the reason in the notes."""
    flow = read_flow(folder / FLOW)
    outcome.notes["spirometer_lag_s"] = true_lag_s
    for name in ("ours", "plain"):
        try:
            found = compare_volumes(outcome.seconds, outcome.tracks[name].volume_l, flow)
        except InvalidValueError as error:
            outcome.notes[f"spirometer_{name}"] = {"refused": str(error)}
            continue
        outcome.notes[f"spirometer_{name}"] = {"lag_s": found.lag_s, "correlation": found.correlation}
        outcome.instruments[f"spirometer_{name}_l"] = found.spirometer_l.astype(np.float32)
        outcome.instruments[f"volume_{name}_l"] = found.tidegate_l.astype(np.float32)


def _from_first(values: FloatArray, is_both: FloatArray) -> Array:
    """Take each column against its first value where both are there."""
    first, points = is_both.argmax(axis=0), np.arange(values.shape[1])
    return np.where(is_both.any(axis=0), values - values[first, points], np.nan).astype(np.float32)
