"""How far recorded markers on skin travel along the couch with the breath: what `max_marker_travel_mm` has to allow.

Run: ``python -m tests.campaigns.measurements.marker_travel FILE [FILE ...]`` with marker recordings of people (CSV),
whose z axis is anterior-posterior. Prints for each the range of x and y together within ten seconds, median and 90th
percentile over the recording.
"""

import sys
from pathlib import Path

import numpy as np

from engine.core.frames import FloatArray
from engine.verification.phantom.traces import read_trace

SPAN_S, STEP_S = 10.0, 5.0
LEAST_SAMPLES = 20


def travels_mm(path: Path) -> FloatArray:
    """Return the travel within each span of ten seconds [mm], shape (spans,)."""
    along, across = (read_trace(path, axis=axis) for axis in ("x", "y"))
    found = []
    for begin_s in np.arange(0.0, along.seconds - SPAN_S, STEP_S):
        is_inside = (along.time_s >= begin_s) & (along.time_s < begin_s + SPAN_S)
        if np.count_nonzero(is_inside) >= LEAST_SAMPLES:
            found.append(np.hypot(np.ptp(along.motion_mm[is_inside]), np.ptp(across.motion_mm[is_inside])))
    return np.array(found)


def main(paths: list[Path]) -> None:
    """Print a line for each recording, and the mean of all medians."""
    medians_mm = []
    for path in paths:
        found_mm = travels_mm(path)
        medians_mm.append(float(np.median(found_mm)))
        _tell(f"{path.name}: median {medians_mm[-1]:.1f} mm, 90th percentile {np.percentile(found_mm, 90):.1f} mm")
    _tell(f"{len(paths)} recordings: medians {min(medians_mm):.1f} to {max(medians_mm):.1f} mm")
    _tell(f"mean of the medians {np.mean(medians_mm):.1f} mm")


def _tell(text: str) -> None:
    print(text)  # noqa: T201 - it is what the command is for


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
