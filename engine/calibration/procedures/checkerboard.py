"""A calibration from pictures of a checkerboard, and its accuracy."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from engine.calibration.camera_calibration import Calibration, parse_calibration
from engine.calibration.procedures.accuracy import AT_MM, PairAccuracy, judge_pair
from engine.calibration.procedures.boards import Board, Coverage, find_corners, find_coverage, read_picture
from engine.calibration.procedures.stereo_pair import BoardPair, PairFit, PictureSizes, fit_pair
from engine.core.errors import CalibrationError, InvalidValueError
from engine.core.geometry import Intrinsics

SCHEMA = "tidegate.calibration-report/1"
LARGEST_OFFSET_PX = 20.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckerboardResult:
    """The calibration, its input, and its accuracy.

    Parameters
    ----------
    unseen
        Pictures in which the board was not found, each with the reason.
    unpaired
        Pictures without a partner in the other camera.
    """

    calibration: Calibration
    fit: PairFit
    accuracy: PairAccuracy
    coverage: dict[str, Coverage]
    unseen: dict[str, str]
    unpaired: tuple[str, ...]

    def report(self) -> dict[str, object]:
        """Write everything down, as plain values."""
        errors = self.fit.errors_px
        return {
            "schema": SCHEMA,
            "calibration_sha256": self.calibration.sha256,
            "at_mm": AT_MM,
            "accuracy": asdict(self.accuracy),
            "focal_sigma_px": {"depth": self.fit.depth.focal_sigma_px, "color": self.fit.color.focal_sigma_px},
            "pictures": [
                {"name": pair.name} | {f"{kind}_px": float(values[i]) for kind, values in errors.items()}
                for i, pair in enumerate(self.fit.pairs)
            ],
            "outliers": self.fit.outliers,
            "board_not_found": self.unseen,
            "without_partner": list(self.unpaired),
            "coverage": {
                name: {"share": seen.share, "empty": list(seen.empty_places)} for name, seen in self.coverage.items()
            },
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundBoards:
    """What was found in the pictures."""

    pairs: tuple[BoardPair, ...]
    sizes: PictureSizes
    unseen: dict[str, str]


def find_boards(
    board: Board, pictures: Sequence[tuple[Path, Path]], on_progress: Callable[[int, int], None] | None = None
) -> FoundBoards:
    """Find the board in every pair of pictures, depth camera's and colour camera's.

    Raises
    ------
    RecordingError
        A picture cannot be read.
    CalibrationError
        The pictures of one camera differ in size.
    """
    pairs, unseen = [], {}
    sizes: dict[str, tuple[int, int]] = {}
    for done, both in enumerate(pictures):
        found = []
        for kind, path in zip(("depth", "color"), both, strict=True):
            picture = read_picture(path)
            size = (picture.shape[1], picture.shape[0])
            if sizes.setdefault(kind, size) != size:
                bound = "of the same size as that camera's first picture ({} x {})".format(*sizes[kind])
                raise CalibrationError(path.name, "{} x {}".format(*size), bound)
            found.append(find_corners(picture, board))
        name = both[0].stem
        missing = [path.name for path, corners in zip(both, found, strict=True) if corners is None]
        depth, color = found
        if depth is None or color is None:
            unseen[name] = f"the whole board is not seen in {' and '.join(missing)}"
        else:
            pairs.append(BoardPair(name=name, depth_px=depth, color_px=color))
        if on_progress is not None:
            on_progress(done + 1, len(pictures))
    if not sizes:
        raise CalibrationError("pictures", "0 pairs", "at least one pair")
    return FoundBoards(pairs=tuple(pairs), sizes=PictureSizes(**sizes), unseen=unseen)


def calibrate(
    board: Board,
    found: FoundBoards,
    *,
    camera: str,
    infrared_offset_px: tuple[float, float] = (0.0, 0.0),
    unpaired: Sequence[str] = (),
) -> CheckerboardResult:
    """Fit both cameras and their pose, and judge the fit.

    Parameters
    ----------
    infrared_offset_px
        Where a point of the infrared picture lies in the *depth* picture, less where it lies in the infrared one; some
        devices compute depth on a window, and move it by that.

    Raises
    ------
    CalibrationError
        Too few pictures, too little tilt, or a result that cannot be true.
    """
    for name, offset in zip(("x", "y"), infrared_offset_px, strict=True):
        if not abs(offset) <= LARGEST_OFFSET_PX:
            raise InvalidValueError(f"infrared-offset {name}", offset, f"at most {LARGEST_OFFSET_PX:g} px")
    fit = fit_pair(board, found.pairs, found.sizes)
    calibration = Calibration(
        camera=camera,
        depth=_moved(fit.depth.intrinsics, infrared_offset_px),
        color=_rounded(fit.color.intrinsics),
        color_from_depth=fit.color_from_depth,
    )
    corners = {"depth": [pair.depth_px for pair in fit.pairs], "color": [pair.color_px for pair in fit.pairs]}
    return CheckerboardResult(
        calibration=parse_calibration(calibration.to_json().encode()),
        fit=fit,
        accuracy=judge_pair(board, fit, found.sizes),
        coverage={name: find_coverage(np.stack(seen), getattr(found.sizes, name)) for name, seen in corners.items()},
        unseen=found.unseen,
        unpaired=tuple(unpaired),
    )


def _moved(camera: Intrinsics, offset_px: tuple[float, float]) -> Intrinsics:
    rounded = _rounded(camera)
    return replace(rounded, cx=round(rounded.cx + offset_px[0], 6), cy=round(rounded.cy + offset_px[1], 6))


def _rounded(camera: Intrinsics) -> Intrinsics:
    """Leave off the digits that mean nothing."""
    k1, k2, p1, p2, k3 = (round(value, 9) for value in camera.distortion)
    values = {name: round(getattr(camera, name), 6) for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, **values, distortion=(k1, k2, p1, p2, k3))
