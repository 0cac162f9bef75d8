"""Whether this surface can be the one of the frame before: skin does not jump.

A sheet or a hand that comes to lie on the patient is smooth, and thin enough it passes for motion: the model explains
it. But it comes within a frame or two, faster than a chest can move. From then on the surface is believed again when
its shape is back, breathing aside, or when a person has looked: set a new zero or learned a new model. A patient who
moves does so as a whole: what a plane can follow, all but a little, is followed, however fast, and so is a change that
takes the markers along.

A cough is faster than that, and bends the body for a moment as no breath does. Some surfaces in its midst may pass, so
what the shape has to come back to is also the last one of a whole second without any doubt.
"""

from dataclasses import dataclass

import numpy as np

from engine.frames import FloatArray
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS

# A cough moves an abdomen at 50 mm/s; noise adds some tenths of a millimetre.
MAX_STEP_MM = 2.0
MAX_STEP_OF_NOISE = 0.25
FRAME_US = 40_000
# So much slower than a cough is what frames that were never seen may have hidden.
MAX_SPEED_MM_S = 25.0
MAX_HIDDEN_US = 500_000
MOVED_PX = 5.0
CALM_US = 1_000_000
# A patient who moves as a whole leaves this much of the change to be bent; a sheet over one side leaves half of it.
BENT_SHARE = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """A surface as it was measured: depth at the region's nodes [mm], where the markers were [px], and when."""

    depth_mm: FloatArray
    markers_px: FloatArray
    timestamp_us: int


class Continuity:
    """Remembers the last surface that was believed, and the last one in calm."""

    def __init__(self) -> None:
        self._last: Seen | None = None
        self._calm: Seen | None = None
        self._calm_since_us: int | None = None
        self._generation = -1
        self._is_broken = False

    def begin_anew(self, generation: int) -> None:
        """Believe the next surface if the model or the zero is another one than before."""
        if generation != self._generation:
            self._last, self._is_broken, self._generation = None, False, generation

    def interrupt(self) -> None:
        """Note that something else lay in the view: what comes next need not follow smoothly, but must be as it was."""
        self._is_broken = self._last is not None
        self._calm_since_us = None

    def doubt(self, seen: Seen, shapes: FloatArray, noise_mm: float) -> str:
        """Return why a surface is not believed; empty when it is, and then it is remembered.

        Parameters
        ----------
        shapes
            The learned components at the nodes, shape (k, nodes).
        noise_mm
            Of the model, see :class:`engine.model.MotionModel`.
        """
        allowed_mm = max(MAX_STEP_MM, MAX_STEP_OF_NOISE * noise_mm)
        last = self._last
        if last is None or _has_moved(seen, last):
            self._calm, self._calm_since_us = None, None
        else:
            misfit_mm = self._misfit_mm(seen, last, shapes, allowed_mm)
            if misfit_mm is not None:
                self._is_broken, self._calm_since_us = True, None
                return (
                    f"the surface changed by {misfit_mm:.1f} mm and skin cannot: look whether anything lies on the "
                    "patient, then set the reference again"
                )
        self._believe(seen)
        return ""

    def _misfit_mm(self, seen: Seen, last: Seen, shapes: FloatArray, allowed_mm: float) -> float | None:
        """Return by how much a surface fits neither the last one nor the last in calm; None when it fits."""
        change: FloatArray = seen.depth_mm - last.depth_mm
        if not self._is_broken:
            hidden_us = min(max(seen.timestamp_us - last.timestamp_us - FRAME_US, 0), MAX_HIDDEN_US)
            return _beyond_mm(change, allowed_mm + MAX_SPEED_MM_S * hidden_us / 1e6)
        misfit_mm = _beyond_mm(_less(change, shapes), allowed_mm)
        if misfit_mm is None or self._calm is None or _has_moved(seen, self._calm):
            return misfit_mm
        is_back = _beyond_mm(_less(seen.depth_mm - self._calm.depth_mm, shapes), allowed_mm) is None
        return None if is_back else misfit_mm

    def _believe(self, seen: Seen) -> None:
        if self._calm_since_us is None or seen.timestamp_us < self._calm_since_us:
            self._calm_since_us = seen.timestamp_us
        if seen.timestamp_us - self._calm_since_us >= CALM_US:
            self._calm = seen
        self._last, self._is_broken = seen, False


def _has_moved(seen: Seen, before: Seen) -> bool:
    """Whether the markers went along with a change."""
    return not np.abs(seen.markers_px - before.markers_px).max() <= MOVED_PX


def _beyond_mm(change_mm: FloatArray, allowed_mm: float) -> float | None:
    """Return the largest change where it is more than skin can; None where it is not, or a whole patient moved."""
    largest_mm = float(np.abs(change_mm).max())
    return None if largest_mm <= allowed_mm or _is_of_a_whole(change_mm, allowed_mm) else largest_mm


def _is_of_a_whole(change_mm: FloatArray, allowed_mm: float) -> bool:
    """Whether a plane follows all of a change but a little; what is no number it does not."""
    if not np.isfinite(change_mm).all():
        return False
    bent_mm = float(np.abs(_less(change_mm, _PLANES)).max())
    return bent_mm <= min(allowed_mm, BENT_SHARE * float(np.abs(change_mm).max()))


def _less(change_mm: FloatArray, shapes: FloatArray) -> FloatArray:
    """Take out of a change what some shapes can follow of it."""
    return change_mm - np.linalg.lstsq(shapes.T, change_mm, rcond=None)[0] @ shapes


def _planes() -> FloatArray:
    """Piston and both tilts at the nodes, shape (3, nodes)."""
    rows, columns = np.mgrid[0:NODE_ROWS, 0:NODE_COLUMNS].reshape(2, -1).astype(np.float64)
    return np.stack([np.ones_like(rows), rows - rows.mean(), columns - columns.mean()])


_PLANES = _planes()
