"""A checkerboard in a colour picture: its pose, and the laser line on it.

Colour pictures from files: a PNG or JPEG, or frames evenly spaced over an ``.oni`` recording.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from engine.calibration.laser_plane import LaserPlaneError
from engine.calibration.procedures.boards import Board
from engine.capture.oni.reader import OniReader
from engine.core.errors import RecordingError
from engine.core.frames import BoolArray, ColorImage, FloatArray, frozen
from engine.core.geometry import Intrinsics, RigidTransform
from lab.evaluation.instruments.laser_line import LineSettings, find_line

MAX_REPROJECTION_PX = 1.5
MIN_POINTS = 15
# On white paper red, green and blue are equally bright, and often near saturation.
ON_PAPER = LineSettings(min_contrast=12.0, max_rival=0.75, max_step_px=4.0, is_on_pattern=True)
OFF_LINE_PX = 0.6
FRAMES_PER_RECORDING = 20
MAX_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LitBoard:
    """A board in one picture, in the colour camera's frame.

    Attributes
    ----------
    reprojection_px
        Root mean square reprojection error of its corners [px].
    points_mm
        Points of the laser line on it [mm], shape (n, 3).
    """

    reprojection_px: float
    points_mm: FloatArray

    def __post_init__(self) -> None:
        """Make the points read-only."""
        frozen(self.points_mm)


def read_board(color: ColorImage, board: Board, camera: Intrinsics) -> LitBoard | str:
    """Find the board and the laser line on it; return the reason, a sentence, if there is none."""
    corners_px = _corners(color, board)
    if corners_px is None:
        return f"no board of {board.columns} x {board.rows} inner corners"
    camera_from_board, rms_px = _pose(corners_px, board, camera)
    if camera_from_board is None or rms_px > MAX_REPROJECTION_PX:
        return f"its corners deviate from the board by {rms_px:.1f} px: is it the right board and calibration?"
    pixels_px = _line_on(color, corners_px, camera)
    if len(pixels_px) < MIN_POINTS:
        return "no laser line on the board"
    return LitBoard(reprojection_px=rms_px, points_mm=_on_plane(camera.rays(pixels_px), camera_from_board))


def _corners(color: ColorImage, board: Board) -> FloatArray | None:
    """Find the inner corners to sub-pixels [px], shape (n, 2), in green and blue, where a red line is faint."""
    plain = color[..., 1:].max(axis=2)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    is_found, corners = cv2.findChessboardCornersSB(plain, (board.columns, board.rows), flags=flags)
    if not is_found:
        return None
    found = np.ascontiguousarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    # The window must not contain the next corner.
    reach = int(np.clip(_spacing(found.reshape(board.rows, board.columns, 2)) / 3.0, 2, 8))
    finest = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    found = np.asarray(cv2.cornerSubPix(plain, found, (reach, reach), (-1, -1), finest))
    return found.astype(np.float64).reshape(-1, 2)


def _spacing(corners_px: FloatArray) -> float:
    """Shortest distance of two neighbouring corners [px]; corners of shape (rows, columns, 2)."""
    along = np.linalg.norm(np.diff(corners_px, axis=1), axis=-1).min()
    return float(min(along, np.linalg.norm(np.diff(corners_px, axis=0), axis=-1).min()))


def _pose(corners_px: FloatArray, board: Board, camera: Intrinsics) -> tuple[RigidTransform | None, float]:
    is_solved, turn, shift = cv2.solvePnP(
        board.points_mm, corners_px, camera.matrix, np.array(camera.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    if not is_solved:
        return None, float("inf")
    turn, shift = cv2.solvePnPRefineLM(
        board.points_mm, corners_px, camera.matrix, np.array(camera.distortion), turn, shift
    )
    pose = RigidTransform(
        rotation=np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64),
        translation_mm=np.asarray(shift, dtype=np.float64).ravel(),
    )
    error = camera.project(pose.apply(board.points_mm)) - corners_px
    return pose, float(np.sqrt((error**2).sum(axis=1).mean()))


def _line_on(color: ColorImage, corners_px: FloatArray, camera: Intrinsics) -> FloatArray:
    """Find the line within the board's corners [px], shape (n, 2); points off the best straight line are removed."""
    region = np.zeros(color.shape[:2], dtype=np.uint8)
    cv2.fillConvexPoly(region, cv2.convexHull(np.rint(corners_px).astype(np.int32)), 1)
    inside: BoolArray = region.astype(np.bool_)
    best: FloatArray = np.zeros((0, 2))
    for is_upright in (False, True):
        pixels_px = find_line(color, inside, is_upright=is_upright, settings=ON_PAPER).pixels_px
        if len(pixels_px) >= MIN_POINTS:
            straight = pixels_px[_is_straight(camera.rays(pixels_px)[:, :2] * (camera.fx, camera.fy))]
            best = straight if len(straight) > len(best) else best
    return best


def _is_straight(points_px: FloatArray) -> BoolArray:
    """Points on the straight line through most of them, shape (n,)."""
    line = cv2.fitLine(points_px.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().astype(np.float64)
    normal = np.array([-line[1], line[0]])
    off_px = (points_px - line[2:]) @ normal
    for _ in range(3):
        near = np.asarray(np.abs(off_px - np.median(off_px)) < 3.0 * OFF_LINE_PX)
        if near.sum() < MIN_POINTS:
            return near
        along = points_px @ line[:2]
        off_px = off_px - np.polyval(np.polyfit(along[near], off_px[near], 1), along)
    return np.asarray(np.abs(off_px) < OFF_LINE_PX)


def _on_plane(rays: FloatArray, camera_from_board: RigidTransform) -> FloatArray:
    """Intersect rays with the board's plane [mm], shape (n, 3)."""
    normal = camera_from_board.rotation[:, 2]
    depth = float(normal @ camera_from_board.translation_mm) / (rays @ normal)
    return np.asarray(depth[:, None] * rays)


def read_pictures(path: Path, camera: Intrinsics) -> Iterator[tuple[str, ColorImage]]:
    """Yield each picture of a file with a name, RGB.

    Raises
    ------
    LaserPlaneError
        The file is no picture, or its size differs from the calibrated camera's.
    RecordingError
        The recording cannot be read, or has no colour frames.
    """
    pictures = _of_recording(path) if path.suffix.lower() == ".oni" else _of_file(path)
    for name, picture in pictures:
        height, width = picture.shape[:2]
        if (width, height) != (camera.width, camera.height):
            bound = f"{camera.width}x{camera.height}, the size of the calibration's colour camera"
            raise LaserPlaneError(name, f"{width}x{height}", bound)
        yield name, picture


def _of_file(path: Path) -> Iterator[tuple[str, ColorImage]]:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise LaserPlaneError("pictures", str(path), f"readable ({error.strerror})") from error
    if len(content) > MAX_BYTES:
        raise LaserPlaneError(path.name, f"{len(content)} bytes or more", f"at most {MAX_BYTES} bytes")
    is_known = content.startswith((b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"))
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if is_known else None
    if picture is None:
        raise LaserPlaneError(path.name, f"{len(content)} bytes", "a PNG or JPEG picture, or an .oni recording")
    yield path.name, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _of_recording(path: Path) -> Iterator[tuple[str, ColorImage]]:
    with OniReader(path) as reader:
        count = sum(not frame.is_depth for frame in reader.frames())
        if count == 0:
            raise RecordingError(f"{path.name}: the recording has no colour frame")
        chosen = set(np.linspace(0, count - 1, min(FRAMES_PER_RECORDING, count)).astype(int).tolist())
        colors = (frame for frame in reader.frames() if not frame.is_depth)
        for index, frame in enumerate(colors):
            if index in chosen:
                yield f"{path.name} frame {index}", frame.decode_color()
