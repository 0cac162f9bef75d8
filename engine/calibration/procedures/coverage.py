"""Coverage of the picture by corners: without corners, lens distortion is extrapolated."""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import BoolArray, FloatArray

COLUMNS, ROWS = 8, 6
_ACROSS, _DOWN = ("left", "middle", "right"), ("upper", "central", "lower")
EMPTY_SHARE = 0.5


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
