"""A unit's depth correction from plates at known distances, and its uncertainty at 850 mm."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from engine.calibration.camera_calibration import Calibration, DepthCorrection, Disparity, parse_calibration
from engine.calibration.procedures.accuracy import AT_MM
from engine.calibration.procedures.flat_plate import PlateReading
from engine.calibration.quantisation import DepthSteps
from engine.core.errors import CalibrationError
from engine.core.frames import FloatArray

SCHEMA = "tidegate.plate-report/1"
NEAREST_MM, FARTHEST_MM = 400.0, 2000.0
# Plates nearer to each other than the first are at one distance; nearer than the second they determine no scale.
SAME_MM, LEAST_APART_MM = 5.0, 100.0
LARGEST_RESIDUAL_MM = 5.0
SMALLEST_DISTANCE_ERROR_MM, LARGEST_DISTANCE_ERROR_MM = 0.05, 10.0
# Of a reading cut off to whole mm: of a plate that faces the camera it does not average out.
ROUNDING_SIGMA_MM = 1.0 / np.sqrt(12.0)
# Only a product is in the depths, baseline times focal length by step; this is the baseline of all PrimeSense sensors.
PRIMESENSE_BASELINE_MM = 75.0
CERTAIN_AGREEMENT = 0.98


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthScale:
    """A depth correction and its uncertainty.

    Parameters
    ----------
    readings, distances_mm
        Readings of the plates, and their true distances.
    residuals_mm
        Corrected reading less distance, shape (plates,).
    has_scale
        Whether a scale was measured; one distance gives the offset alone.
    error_mm
        Standard deviation of corrected depth at 850 mm; without a scale, at the plates' own distance.
    """

    correction: DepthCorrection
    readings: tuple[PlateReading, ...]
    distances_mm: FloatArray
    residuals_mm: FloatArray
    has_scale: bool
    error_mm: float

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.square(self.residuals_mm).mean()))

    def report(self) -> dict[str, object]:
        """Write everything down, as plain values."""
        plates = [
            {**asdict(reading), "distance_mm": float(distance), "residual_mm": float(residual)}
            for reading, distance, residual in zip(self.readings, self.distances_mm, self.residuals_mm, strict=True)
        ]
        return {
            "schema": SCHEMA,
            "depth_correction": asdict(self.correction),
            "has_scale": self.has_scale,
            "rms_mm": self.rms_mm,
            "at_mm": AT_MM if self.has_scale else float(self.distances_mm.mean()),
            "error_mm": self.error_mm,
            "plates": plates,
        }


def check_distances(distances_mm: Sequence[float], recordings: int) -> None:
    """Refuse distances that cannot be, or are not as many as the recordings; raise CalibrationError."""
    if len(distances_mm) != recordings:
        bound = f"one for each recording, in their order ({recordings})"
        raise CalibrationError("distance-mm", f"{len(distances_mm)} distances", bound)
    for distance in distances_mm:
        if not NEAREST_MM <= distance <= FARTHEST_MM:
            raise CalibrationError("distance-mm", distance, f"from {NEAREST_MM:g} to {FARTHEST_MM:g}")
    apart_mm = max(distances_mm) - min(distances_mm)
    if SAME_MM < apart_mm < LEAST_APART_MM:
        bound = f"one distance, or several at least {LEAST_APART_MM:g} mm apart"
        raise CalibrationError("distance-mm", f"{apart_mm:g} mm apart", bound)


def fit_depth_scale(
    readings: Sequence[PlateReading],
    distances_mm: Sequence[float],
    *,
    distance_error_mm: float = 1.0,
    is_rounding_undone: bool = True,
) -> DepthScale:
    """Fit ``distance = scale * reading + offset`` by least squares.

    Parameters
    ----------
    distance_error_mm
        Standard deviation of the distances as measured; the residuals' own where they are larger.
    is_rounding_undone
        Whether the readings were freed of their rounding to whole mm, which else is an error of its own.

    Raises
    ------
    CalibrationError
        A plate far off the line: a distance is wrong, or the plates belong to other recordings.
    """
    check_distances(distances_mm, len(readings))
    if not SMALLEST_DISTANCE_ERROR_MM <= distance_error_mm <= LARGEST_DISTANCE_ERROR_MM:
        bound = f"from {SMALLEST_DISTANCE_ERROR_MM:g} to {LARGEST_DISTANCE_ERROR_MM:g}"
        raise CalibrationError("distance-error-mm", distance_error_mm, bound)
    reading_mm = np.array([reading.reading_mm for reading in readings])
    distance_mm = np.array(distances_mm, dtype=np.float64)
    has_scale = float(np.ptp(distance_mm)) > SAME_MM
    design = np.column_stack([reading_mm, np.ones_like(reading_mm)])[:, 0 if has_scale else 1 :]
    target = distance_mm if has_scale else distance_mm - reading_mm
    solution, *_ = np.linalg.lstsq(design, target, rcond=None)
    residuals_mm = design @ solution - target
    worst = int(np.abs(residuals_mm).argmax())
    if abs(residuals_mm[worst]) > max(LARGEST_RESIDUAL_MM, 3.0 * distance_error_mm):
        bound = f"within {max(LARGEST_RESIDUAL_MM, 3.0 * distance_error_mm):g} mm of a line through all plates"
        raise CalibrationError(
            "distance-mm", f"{distance_mm[worst]:g} ({readings[worst].name}), {residuals_mm[worst]:.1f} mm off", bound
        )
    scale, offset = (float(solution[0]), float(solution[1])) if has_scale else (1.0, float(solution[0]))
    at = np.array([(AT_MM - offset) / scale, 1.0])[0 if has_scale else 1 :]
    freedom = len(readings) - design.shape[1]
    sigma_mm = distance_error_mm if is_rounding_undone else float(np.hypot(distance_error_mm, ROUNDING_SIGMA_MM))
    if freedom > 0:
        sigma_mm = max(sigma_mm, float(np.sqrt(np.square(residuals_mm).sum() / freedom)))
    variance = float(at @ np.linalg.inv(design.T @ design) @ at) * sigma_mm**2
    return DepthScale(
        correction=DepthCorrection(scale=round(scale, 7), offset_mm=round(offset, 4)),
        readings=tuple(readings),
        distances_mm=distance_mm,
        residuals_mm=residuals_mm,
        has_scale=has_scale,
        error_mm=float(np.sqrt(variance)),
    )


def disparity_of(calibration: Calibration, steps: DepthSteps | None) -> Disparity | None:
    """Convert the sensor's steps of 1/z to the calibration's disparity; None where they are uncertain.

    The step in px is for the baseline of PrimeSense sensors: only their ratio is in the depths, and only it is used.
    """
    if steps is None or steps.agreement < CERTAIN_AGREEMENT:
        return None
    step_px = abs(steps.step_per_mm) * calibration.depth.fx * PRIMESENSE_BASELINE_MM
    return Disparity(baseline_mm=PRIMESENSE_BASELINE_MM, step_px=round(step_px, 8))


def corrected(calibration: Calibration, scale: DepthScale, disparity: Disparity | None) -> Calibration:
    """Put the correction, and the steps where they are certain, into a calibration; raise CalibrationError."""
    made = replace(
        calibration, depth_correction=scale.correction, disparity=disparity if disparity else calibration.disparity
    )
    return parse_calibration(made.to_json().encode())
