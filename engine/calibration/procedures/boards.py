"""A checkerboard and where a picture shows its inner corners.

Coverage of the picture by corners: without corners, lens distortion is extrapolated.

Pairs of pictures: by equal names, else by their order.
"""

import glob
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError, RecordingError
from engine.core.frames import BoolArray, FloatArray

FEWEST_CORNERS, MOST_CORNERS = 3, 40
SMALLEST_SQUARE_MM, LARGEST_SQUARE_MM = 2.0, 200.0
MAX_PICTURE_BYTES = 64 * 1024 * 1024
MAX_PICTURE_PX = 4096
# Pictures of the infrared camera are dark, and have 10 or 16 bits: stretched between these shares of their pixels.
_STRETCH_PERCENT = (0.5, 99.5)
# Half of the window a corner is refined in: its own quarter of the four squares around, not the next corner's.
_WINDOW_SHARE = 0.4
_SMALLEST_WINDOW_PX, _LARGEST_WINDOW_PX = 2, 15
Gray = npt.NDArray[np.uint8]
COLUMNS, ROWS = 8, 6
_ACROSS, _DOWN = ("left", "middle", "right"), ("upper", "central", "lower")
EMPTY_SHARE = 0.5
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")
MOST_PICTURES = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A checkerboard, by its inner corners: squares less one, along both sides; the side of a square [mm]."""

    columns: int
    rows: int
    square_mm: float

    def __post_init__(self) -> None:
        """Refuse what is no board, or one that looks the same when turned by a quarter."""
        for name, value in (("columns", self.columns), ("rows", self.rows)):
            if not FEWEST_CORNERS <= value <= MOST_CORNERS:
                raise InvalidValueError(name, value, f"from {FEWEST_CORNERS} to {MOST_CORNERS} inner corners")
        if self.columns == self.rows:
            bound = "different from columns: a square board can be read in four ways"
            raise InvalidValueError("rows", self.rows, bound)
        if not SMALLEST_SQUARE_MM <= self.square_mm <= LARGEST_SQUARE_MM:
            bound = f"from {SMALLEST_SQUARE_MM:g} to {LARGEST_SQUARE_MM:g} mm"
            raise InvalidValueError("square_mm", self.square_mm, bound)

    @property
    def points_mm(self) -> FloatArray:
        """The corners in the board's own frame, row by row, z = 0 [mm]; shape (rows * columns, 3), float64."""
        grid = np.mgrid[0 : self.rows, 0 : self.columns].reshape(2, -1).T[:, ::-1] * self.square_mm
        return np.column_stack([grid, np.zeros(len(grid))])


def read_picture(path: Path) -> Gray:
    """Read a picture as grey levels, shape (H, W), stretched to its own range; raise RecordingError."""
    try:
        if path.stat().st_size > MAX_PICTURE_BYTES:
            msg = f"{path.name}: a picture of more than {MAX_PICTURE_BYTES // 2**20} MB"
            raise RecordingError(msg)
        coded = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        msg = f"{path.name} cannot be read ({error.strerror})"
        raise RecordingError(msg) from error
    try:
        picture = cv2.imdecode(coded, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if coded.size else None
    except cv2.error:
        picture = None
    if picture is None or max(picture.shape) > MAX_PICTURE_PX:
        msg = f"{path.name} is no picture of at most {MAX_PICTURE_PX} px that can be read"
        raise RecordingError(msg)
    return _stretched(np.asarray(picture))


def find_corners(picture: Gray, board: Board) -> FloatArray | None:
    """Find the board's inner corners, row by row; which end is the first is arbitrary.

    Returns
    -------
    FloatArray or None
        Pixels (x, y), shape (rows * columns, 2), float64; None where the whole board is not seen.
    """
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    is_found, corners = cv2.findChessboardCornersSB(picture, (board.columns, board.rows), flags=flags)
    if not is_found:
        return None
    return _refined(picture, np.asarray(corners, dtype=np.float32).reshape(board.rows, board.columns, 2))


def _refined(picture: Gray, corners: npt.NDArray[np.float32]) -> FloatArray:
    """Find each corner again as a saddle of its own surroundings: on drawn boards that halves its error."""
    steps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).min() for axis in (0, 1)]
    half_px = int(np.clip(_WINDOW_SHARE * min(steps), _SMALLEST_WINDOW_PX, _LARGEST_WINDOW_PX))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
    flat = corners.reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(picture, flat.copy(), (half_px, half_px), (-1, -1), stop)
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)


def _stretched(picture: npt.NDArray[np.generic]) -> Gray:
    levels = picture.astype(np.float32)
    low, high = np.percentile(levels, _STRETCH_PERCENT)
    if high <= low:
        return np.zeros(levels.shape, np.uint8)
    return np.asarray(np.clip((levels - low) * (255.0 / (high - low)), 0.0, 255.0), dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Coverage:
    """Cells of the picture, shape (6, 8): whether a corner ever was in them."""

    cells: BoolArray

    @property
    def share(self) -> float:
        """Share of the picture's cells that had a corner."""
        return float(self.cells.mean())

    @property
    def empty_places(self) -> tuple[str, ...]:
        """Ninths of the picture in which hardly any cell had a corner, by name."""
        places = []
        for rows, down in zip(np.array_split(np.arange(ROWS), 3), _DOWN, strict=True):
            for columns, across in zip(np.array_split(np.arange(COLUMNS), 3), _ACROSS, strict=True):
                if self.cells[np.ix_(rows, columns)].mean() < EMPTY_SHARE:
                    places.append(f"{down} {across}")
        return tuple(places)


def find_coverage(corners_px: FloatArray, size_px: tuple[int, int]) -> Coverage:
    """Find it from all pictures' corners, shape (..., 2)."""
    flat = corners_px.reshape(-1, 2) + 0.5
    counts, _, _ = np.histogram2d(
        flat[:, 1], flat[:, 0], bins=(ROWS, COLUMNS), range=((0.0, size_px[1]), (0.0, size_px[0]))
    )
    return Coverage(cells=counts > 0)


def list_pictures(field: str, where: str) -> list[Path]:
    """List a folder's pictures, or a pattern's, sorted by name; raise InvalidValueError when there are none."""
    folder = Path(where)
    found = folder.iterdir() if folder.is_dir() else (Path(name) for name in glob.glob(where))  # noqa: PTH207 - absolute patterns too
    pictures = sorted(path for path in found if path.suffix.lower() in SUFFIXES and path.is_file())
    if not 1 <= len(pictures) <= MOST_PICTURES:
        bound = f"a folder or a pattern with 1 to {MOST_PICTURES} pictures ({' '.join(SUFFIXES)})"
        raise InvalidValueError(field, f"{where} ({len(pictures)} pictures)", bound)
    return pictures


def match_pictures(depth: list[Path], color: list[Path]) -> tuple[list[tuple[Path, Path]], list[str]]:
    """Pair the depth camera's pictures with the colour camera's.

    Returns
    -------
    tuple
        The pairs, and the names of pictures without a partner.

    Raises
    ------
    InvalidValueError
        No names are equal, and the numbers of pictures differ.
    """
    by_stem = {path.stem: path for path in color}
    if len(by_stem) != len(color) or len({path.stem for path in depth}) != len(depth):
        raise InvalidValueError("pictures", "two of one name", "one picture of a name for each camera")
    pairs = [(path, by_stem[path.stem]) for path in depth if path.stem in by_stem]
    if pairs:
        paired = {path.stem for path, _ in pairs}
        return pairs, [path.name for path in depth + color if path.stem not in paired]
    if len(depth) != len(color):
        bound = f"as many as the depth camera's ({len(depth)}), or named as they are"
        raise InvalidValueError("color-pictures", f"{len(color)} pictures", bound)
    return list(zip(depth, color, strict=True)), []
