"""RPM ``.vxp`` of a breathing curve, for programs of research that read such files.

The rule of the file's checksum is not known, so the field is left out: a system that checks it refuses the file.
"""

from datetime import date

import numpy as np
import numpy.typing as npt

from engine.core.frames import FloatArray

SCALE = 10.0
"""Millimetres of one unit of the amplitude."""
LOST, NOT_PERIODIC = -1, -2
LAYOUT = "amplitude,phase,timestamp,validflag,ttlin,mark,ttlout"


def vxp(
    *,
    time_s: FloatArray,
    motion_mm: FloatArray,
    place: FloatArray,
    is_on: npt.NDArray[np.bool_],
    patient_id: str,
    day: date | None = None,
    image_s: FloatArray | None = None,
    is_low_active: bool = False,
) -> str:
    """Write a curve.

    Parameters
    ----------
    place
        Place in the breath, 0 at the end of inhale, NaN where not known: flagged as not periodic.
    is_on
        Whether the gate permitted the beam: ``ttlout``.
    image_s
        Times of the CT's images [s]: ``ttlin`` is active in the sample nearest to each.
    is_low_active
        Whether an active ``ttlin`` is 0: readers and scanners disagree.
    """
    rate = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
    active = np.zeros(len(time_s), dtype=bool)
    if image_s is not None:
        active[np.abs(time_s[None, :] - np.asarray(image_s)[:, None]).argmin(axis=1)] = True
    head = [
        "[Header]",
        "Version=1.6",
        f"Data_layout={LAYOUT}",
        f"Patient_ID={''.join(one for one in patient_id if one.isprintable())}",
        f"Date={(day or date(1900, 1, 1)):%m-%d-%Y}",
        f"Total_study_time={time_s[-1] - time_s[0]:.3f}",
        f"Samples_per_second={round(rate)}",
        f"Scale_factor={SCALE:.1f}",
        "[Data]",
    ]
    rows = []
    level = marks_at = None
    for i, (at, mm, part) in enumerate(zip(time_s, motion_mm, place, strict=True)):
        is_known, is_periodic = bool(np.isfinite(mm)), bool(np.isfinite(part))
        level = mm if is_known else level
        amplitude = 0.0 if level is None else -level / SCALE  # the raw value falls on inhale
        mark = ""
        if is_periodic and marks_at is not None:
            mark = "Z" if part < marks_at else "P" if marks_at < 0.5 <= part else ""
        marks_at = part if is_periodic else None
        flag = LOST if not is_known else 0 if is_periodic else NOT_PERIODIC
        radians = 2.0 * np.pi * part if is_periodic else 0.0
        ttl = int(active[i] != is_low_active)
        rows.append(f"{amplitude:.4f},{radians:.4f},{round(1000.0 * at)},{flag},{ttl},{mark},{int(is_on[i])}")
    return "\r\n".join([*head, *rows, ""])
