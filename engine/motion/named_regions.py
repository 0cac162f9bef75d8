"""Named regions: simple polygons on the region's grid, with exact pixel coverage.

Coordinates are (row, column) of the 350 x 200 grid, pixel centres at integers: pixel (0, 0) extends from -0.5 to 0.5,
so a polygon extends at most from -0.5 to 349.5 and from -0.5 to 199.5. A pixel on its edge is weighted by the share of
its area inside.

Readers of named regions: files of schema ``tidegate.regions/1``, and regions given on the command line.

The file is JSON with exactly these keys: ``schema``, and ``regions``, a list of objects with ``name`` and ``vertices``,
a list of [row, column] on the region's grid. `engine.motion.named_regions` defines a valid region.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray
from engine.core.strict_json import ROOT, StrictJson

MIN_VERTICES = 3
MAX_VERTICES = 64
MAX_REGIONS = 32
MIN_AREA_PX = 25.0  # as the smallest cell: the sensor's noise is correlated over about nine pixels
NAME_PATTERN = r"^[a-z][a-z0-9_]{0,31}$"
RESERVED_NAMES = frozenset({"whole", "thorax", "abdomen", "region", "signal", "residual"})
_POINT_NAME = re.compile(r"p\d+_\d+")
_LOWEST = -0.5
_HIGHEST = (ROI_ROWS - 0.5, ROI_COLUMNS - 0.5)
SCHEMA = "tidegate.regions/1"
_READER = StrictJson(max_bytes=256 * 1024)
_LIMIT = 1e6  # a coarse bound on rows and columns; NamedRegion checks the exact ones


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedRegion:
    """A named polygon, validated when it is made.

    Attributes
    ----------
    name
        Lower case letters, digits and underscores; not the name of another signal (`RESERVED_NAMES`) or of a point.
    vertices
        (row, column) around the polygon in either direction, the first not repeated at the end; 3 to 64 vertices.
    """

    name: str
    vertices: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Check name, vertices, self-intersection and area; raise InvalidValueError."""
        _check_name(self.name)
        field = f"region {self.name}"
        if not MIN_VERTICES <= len(self.vertices) <= MAX_VERTICES:
            raise InvalidValueError(field, f"{len(self.vertices)} vertices", f"{MIN_VERTICES} to {MAX_VERTICES}")
        for row, column in self.vertices:
            if not (_LOWEST <= row <= _HIGHEST[0] and _LOWEST <= column <= _HIGHEST[1]):  # so that NaN fails
                bound = f"inside the grid: row -0.5 to {_HIGHEST[0]:g}, column -0.5 to {_HIGHEST[1]:g}"
                raise InvalidValueError(field, f"vertex {row:g},{column:g}", bound)
        crossing = _first_crossing(np.array(self.vertices, dtype=np.float64))
        if crossing is not None:
            value = f"edges {crossing[0] + 1} and {crossing[1] + 1} meeting"
            raise InvalidValueError(field, value, "a simple polygon: its edges meet at its vertices only")
        area_px = enclosed_px(self.vertices)
        if area_px < MIN_AREA_PX:
            raise InvalidValueError(field, f"{area_px:.1f} pixels", f"at least {MIN_AREA_PX:g} pixels large")


def check_regions(regions: tuple[NamedRegion, ...]) -> None:
    """Raise InvalidValueError for too many regions or a repeated name."""
    if len(regions) > MAX_REGIONS:
        raise InvalidValueError("regions", f"{len(regions)} regions", f"at most {MAX_REGIONS}")
    names = [region.name for region in regions]
    for name in names:
        if names.count(name) > 1:
            raise InvalidValueError("regions", name, "given once: region names must be unique")


def enclosed_px(vertices: tuple[tuple[float, float], ...]) -> float:
    """Area of a polygon by the shoelace formula [px^2]."""
    rows, columns = np.array(vertices, dtype=np.float64).T
    return 0.5 * abs(float(rows @ np.roll(columns, -1) - columns @ np.roll(rows, -1)))


def coverage(vertices: tuple[tuple[float, float], ...]) -> FloatArray:
    """Exact share of each pixel of the grid inside a simple polygon, shape (350, 200), 0 to 1.

    Every edge is cut at the pixel borders. A piece that descends by ``dy`` contributes the strip to its right: a part
    of its own pixel, and ``dy`` of every pixel to the right of it.
    """
    edges = np.zeros((ROI_ROWS + 1, ROI_COLUMNS + 2))
    corners = np.array(vertices, dtype=np.float64)[:, ::-1] + 0.5  # (x, y), pixel (0, 0) from 0 to 1
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points = _cut_at_pixels(start, end)
        middle = 0.5 * (points[1:] + points[:-1])
        falls = np.diff(points[:, 1])
        columns, rows = np.floor(middle).astype(np.intp).T
        beyond = middle[:, 0] - columns
        np.add.at(edges, (rows, columns), falls * (1.0 - beyond))
        np.add.at(edges, (rows, columns + 1), falls * beyond)
    inside = np.abs(np.cumsum(edges, axis=1))[:ROI_ROWS, :ROI_COLUMNS]
    return np.asarray(np.clip(np.round(inside, 9), 0.0, 1.0))  # so that whole pixels are whole


def _cut_at_pixels(start: FloatArray, end: FloatArray) -> FloatArray:
    """Cut a segment at the pixel borders: points (x, y), ends included, shape (n, 2)."""
    shares = [np.array([0.0, 1.0])]
    for axis in (0, 1):
        low, high = sorted((float(start[axis]), float(end[axis])))
        lines = np.arange(np.ceil(low), np.floor(high) + 1.0)
        if high > low:
            shares.append((lines - start[axis]) / (end[axis] - start[axis]))
    share = np.unique(np.clip(np.concatenate(shares), 0.0, 1.0))[:, None]
    return np.asarray((1.0 - share) * start + share * end)


def _check_name(name: str) -> None:
    if not re.match(NAME_PATTERN, name) or name.endswith("\n"):
        raise InvalidValueError("region", name, "named by 1 to 32 of a-z, 0-9 and _, a letter first")
    if name in RESERVED_NAMES or _POINT_NAME.fullmatch(name):
        raise InvalidValueError("region", name, "another name: this one is reserved for another signal")


def _first_crossing(vertices: FloatArray) -> tuple[int, int] | None:
    """Find two non-adjacent edges that meet; edge i runs from vertex i to the next."""
    # Adjacent edges need no test: one that folds back or has no length makes its neighbours meet, or leaves no area.
    count = len(vertices)
    along = np.roll(vertices, -1, axis=0) - vertices
    first, second = np.triu_indices(count, 2)
    apart = (first != 0) | (second != count - 1)
    first, second = first[apart], second[apart]
    meets = _segments_meet(vertices, along, first, second)
    if not meets.any():
        return None
    found = int(np.flatnonzero(meets)[0])
    return int(first[found]), int(second[found])


def _segments_meet(vertices: FloatArray, along: FloatArray, first: FloatArray, second: FloatArray) -> BoolArray:
    """Whether edges ``first`` and ``second`` share a point, ends included, shape (pairs,)."""
    a, b, c, d = vertices[first], (vertices + along)[first], vertices[second], (vertices + along)[second]
    sides_of_first = np.sign(_cross(b - a, c - a)) * np.sign(_cross(b - a, d - a))
    sides_of_second = np.sign(_cross(d - c, a - c)) * np.sign(_cross(d - c, b - c))
    boxes = (np.maximum(np.minimum(a, b), np.minimum(c, d)) <= np.minimum(np.maximum(a, b), np.maximum(c, d))).all(
        axis=1
    )
    return np.asarray((sides_of_first <= 0.0) & (sides_of_second <= 0.0) & boxes)


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def load_regions(path: Path) -> tuple[NamedRegion, ...]:
    """Read a regions file; raise InvalidValueError naming field, value and bound."""
    fields = _READER.fields(ROOT, _READER.load(path), required=("schema", "regions"))
    if fields["schema"] != SCHEMA:
        raise InvalidValueError("schema", fields["schema"], repr(SCHEMA))
    items = _READER.items("regions", fields["regions"], 1, MAX_REGIONS)
    regions = tuple(_region(f"regions[{i}]", item) for i, item in enumerate(items))
    check_regions(regions)
    return regions


def parse_region(text: str) -> NamedRegion:
    """Parse ``NAME=ROW,COL;ROW,COL;...``; raise InvalidValueError naming value and bound."""
    name, _, corners = text.partition("=")
    try:
        vertices = tuple(_pair(corner) for corner in corners.split(";"))
    except ValueError as error:
        raise InvalidValueError("region", text, "NAME=ROW,COL;ROW,COL;ROW,COL..., two numbers per vertex") from error
    return NamedRegion(name=name, vertices=vertices)


def _pair(corner: str) -> tuple[float, float]:
    row, column = (float(part) for part in corner.split(","))
    return row, column


def _region(field: str, value: object) -> NamedRegion:
    fields = _READER.fields(field, value, required=("name", "vertices"))
    name = _READER.name(f"{field}.name", fields["name"])
    corners = _READER.items(f"{field}.vertices", fields["vertices"], MIN_VERTICES, MAX_VERTICES)
    vertices = []
    for i, corner in enumerate(corners):
        row, column = _READER.vector(f"{field}.vertices[{i}]", corner, 2, -_LIMIT, _LIMIT)
        vertices.append((row, column))
    return NamedRegion(name=name, vertices=tuple(vertices))
