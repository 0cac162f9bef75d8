"""Readers of named regions: files of schema ``tidegate.regions/1``, and regions given on the command line.

The file is JSON with exactly these keys: ``schema``, and ``regions``, a list of objects with ``name`` and ``vertices``,
a list of [row, column] on the region's grid. `engine.motion.named_regions` defines a valid region.
"""

from pathlib import Path

from engine.core.errors import InvalidValueError
from engine.core.strict_json import ROOT, StrictJson
from engine.motion.named_regions import MAX_REGIONS, MAX_VERTICES, MIN_VERTICES, NamedRegion, check_regions

SCHEMA = "tidegate.regions/1"
_READER = StrictJson(max_bytes=256 * 1024)
_LIMIT = 1e6  # a coarse bound on rows and columns; NamedRegion checks the exact ones


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
