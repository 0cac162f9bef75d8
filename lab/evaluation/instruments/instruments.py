"""Laser line and spirometer of a trial, as in the article's sections 4.5.1 and 4.5.2."""

from pathlib import Path

import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.calibration.laser_plane import load_plane
from engine.core.errors import InvalidValueError
from engine.core.frames import FloatArray, Measurement, RgbdFrame
from lab.evaluation.instruments.flow_file import read_flow
from lab.evaluation.instruments.laser import LaserGauge
from lab.evaluation.instruments.laser_line import CellSurface
from lab.evaluation.instruments.spirometer import compare_volumes
from lab.evaluation.methods.outcome import Array, Outcome
from lab.phantom.truth import CELL_PX

LINE_SHARES = np.linspace(0.05, 0.95, 37)
"""Positions along the line through the ROI, as shares of its length (Figure 13)."""
FIVE = (4, 11, 18, 25, 32)
"""Indices of the five points of Table 2 in `LINE_SHARES`: 15, 32.5, 50, 67.5 and 85 %."""
PLANE, FLOW = "plane.json", "flow.csv"


class LaserSide:
    """Measures the laser line in the frames that Tidegate measures."""

    def __init__(self, calibration: Calibration, folder: Path) -> None:
        plane = load_plane(folder / PLANE)
        self._gauge = LaserGauge(calibration, plane, shares=LINE_SHARES.tolist(), cell_px=CELL_PX)

    def add_frame(self, frame: RgbdFrame, measurement: Measurement) -> None:
        """Add the next frame and Tidegate's measurement of it."""
        self._gauge.add(frame, measurement)

    def compare(self, plain_depth_mm: FloatArray) -> dict[str, Array]:
        """Return the motions by laser, Tidegate and the plain method.

        Parameters
        ----------
        plain_depth_mm
            Depth of the cells by the plain method [mm], shape (n, 35, 20); NaN where it did not measure.

        Returns
        -------
        dict
            ``laser_mm`` and ``laser_ours_mm``: motion of points near the line, shape (n, 37); ``laser_line_mm`` and
            ``laser_plain_mm``: motion of the line itself at the five points by the laser and by the plain method,
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
    """Compare the volumes with the spirometer's and add them to ``outcome``; its notes hold the reason of a failure."""
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
    """Subtract from each column its first value at which ``is_both`` holds; NaN where there is none."""
    first, points = is_both.argmax(axis=0), np.arange(values.shape[1])
    return np.where(is_both.any(axis=0), values - values[first, points], np.nan).astype(np.float32)
