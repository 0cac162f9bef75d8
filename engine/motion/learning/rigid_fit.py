"""Rigid motion between two sets of corresponding points (Kabsch algorithm)."""

from dataclasses import dataclass, field

import numpy as np

from engine.core.frames import FloatArray

MIN_POINTS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidFit:
    """A rigid motion between two sets of points, and the remaining difference.

    Attributes
    ----------
    shift_mm
        From the centre of the first to the centre of the second (x, y, z) [mm].
    tilt_deg
        Angle of the rotation about that centre [deg].
    shape_mm
        Root mean square distance of the points after the rigid motion [mm].
    rotation
        About that centre, shape (3, 3).
    share
        Share of the pairs that was used, 0 to 1.
    """

    shift_mm: tuple[float, float, float]
    tilt_deg: float
    shape_mm: float
    rotation: FloatArray = field(compare=False, repr=False)
    share: float

    @property
    def distance_mm(self) -> float:
        """Length of the shift [mm]."""
        return float(np.linalg.norm(self.shift_mm))


def rigid_between(first: FloatArray, second: FloatArray) -> RigidFit | None:
    """Fit the rigid motion from ``first`` to ``second``.

    Parameters
    ----------
    first, second
        Points [mm], shape (N, 3); pairs with a NaN are left out.

    Returns
    -------
    RigidFit | None
        None for fewer than 12 pairs.
    """
    both = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if int(both.sum()) < MIN_POINTS:
        return None
    a, b = first[both], second[both]
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    u, _, v = np.linalg.svd((a - center_a).T @ (b - center_b))
    handedness = np.sign(np.linalg.det(u @ v))  # a mirror image is no rotation
    rotation = v.T @ np.diag([1.0, 1.0, handedness]) @ u.T
    left = (b - center_b) - (a - center_a) @ rotation.T
    cosine = np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)
    x, y, z = (center_b - center_a).tolist()
    return RigidFit(
        shift_mm=(x, y, z),
        tilt_deg=float(np.rad2deg(np.arccos(cosine))),
        shape_mm=float(np.sqrt((left**2).sum(axis=1).mean())),
        rotation=rotation,
        share=float(both.mean()),
    )
