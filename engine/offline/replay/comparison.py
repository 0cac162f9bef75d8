"""How close a replay has to be to the recorded session: equal bits, or within the rounding of another processor.

A vector library adds the same numbers in another order on another processor, so the last bits of what is measured
differ there (a few 1e-5 mm). The gate's decisions must be the same on every processor.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from platform import machine, python_version
from typing import Any

import cv2
import numpy as np
from threadpoolctl import threadpool_info

from engine.core.compiled import frame_path

Row = dict[str, Any]

DIGEST = "digest"
OPENCV_FEATURES = "opencv features"
PROCESSOR = "processor"
"""The processor's name does not determine the numbers; its features do."""

MOTION_MM = 1e-3
VOLUME_L = 2e-4
"""1e-3 mm over 0.2 m² of a chest."""

ROUNDING: Mapping[str, float] = {
    **dict.fromkeys(("whole_mm", "thorax_mm", "abdomen_mm", "signal_mm", "residual_mm"), MOTION_MM),
    **dict.fromkeys(("regions_mm", "named_mm"), MOTION_MM),
    "volume_l": VOLUME_L,
    "valid_share": 0.002,
    "inlier_share": 0.002,
    "detail": MOTION_MM,
}
"""Tolerances of a row's numbers. Numbers in a transition's text may also differ by their last digit."""

NUMBERS = frozenset(ROUNDING) - {"detail"}

FOLLOWING = frozenset(
    {
        *("phase_percent", "phase_confidence", "rate_per_min"),
        *("breath_amplitude", "breath_baseline", "breath_drift"),
    }
)
"""Numbers that jump where an extremum moves to the next frame by a rounding. The gate's decisions cover their use."""

ADDED = frozenset({"armed_by"})
"""Columns that earlier tapes do not have."""

_NUMBER = re.compile(r"-?\d+(?:\.(\d+))?")


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Defines when two rows are equal.

    Attributes
    ----------
    tolerances
        Tolerance of each numeric column; all other values have to be equal.
    ignored
        Columns that are not compared.
    reasons
        What differs between the machine of the recording and this one; empty for a comparison to the last bit.
    """

    tolerances: Mapping[str, float] = field(default_factory=dict)
    ignored: frozenset[str] = frozenset()
    reasons: tuple[str, ...] = ()

    @property
    def is_exact(self) -> bool:
        """Whether every bit has to be the same."""
        return not self.tolerances

    def differing(self, then: Row, now: Row) -> list[str]:
        """Return the names of the values in which ``then`` (recorded) and ``now`` (replayed) differ."""
        return [
            name
            for name, value in then.items()
            if name not in self.ignored and not self._agrees(name, value, now.get(name))
        ]

    def agrees(self, then: Row, now: Row) -> bool:
        """Whether two rows are equal."""
        added = ADDED - then.keys()
        return then.keys() == now.keys() - added and not self.differing(then, now)

    def _agrees(self, name: str, then: object, now: object) -> bool:
        tolerance = self.tolerances.get(name)
        if tolerance is None:
            return same_bits(then, now)
        if isinstance(then, str) and isinstance(now, str):
            return _text_agrees(then, now, tolerance)
        if then is None or now is None:
            return then is now
        return _numbers_agree(then, now, tolerance)


BIT_FOR_BIT = Comparison()


def within_rounding(reasons: Sequence[str] = ()) -> Comparison:
    """Return the comparison for a session of another or an unknown processor."""
    return Comparison(tolerances=ROUNDING, ignored=FOLLOWING | {DIGEST}, reasons=tuple(reasons))


def comparison_of(recorded: Mapping[str, str], here: Mapping[str, str]) -> Comparison:
    """Choose the comparison for a session by the machine it ran on and this one, as :func:`this_machine` names them.

    Equal bits where everything but the processor's name is the same; a tape without features is of an unknown
    processor.
    """
    reasons = tuple(
        f"{name} {recorded.get(name, 'unknown')} there, {value} here"
        for name, value in here.items()
        if name != PROCESSOR and recorded.get(name) != value
    )
    if not reasons:
        return BIT_FOR_BIT
    comparison = within_rounding(reasons)
    if OPENCV_FEATURES in recorded:
        return comparison
    # Written before tapes named the features: texts were reworded since, and the reason's code is the decision.
    return replace(comparison, ignored=comparison.ignored | {"detail"})


def same_bits(one: object, other: object) -> bool:
    """Whether two JSON values are equal to the last bit; NaN equals NaN."""
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


def this_machine() -> dict[str, str]:
    """Return what numbers depend on besides the version: processor, features in use, and libraries."""
    simd = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[call-overload, unused-ignore, index]
    return {
        PROCESSOR: _processor(),
        "architecture": machine(),
        "frame path": frame_path(),
        OPENCV_FEATURES: cv2.getCPUFeaturesLine(),
        "numpy features": " ".join([*simd["baseline"], *simd.get("found", ())]),
        "blas kernels": " ".join(sorted({str(one.get("architecture", "")) for one in threadpool_info()})),
        "python": python_version(),
        "numpy": version("numpy"),
        "opencv": version("opencv-python-headless"),
        "scipy": version("scipy"),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), machine())


def _numbers_agree(then: object, now: object, tolerance: float) -> bool:
    """Compare two numbers, or two lists of them; NaN agrees with NaN."""
    try:
        one, other = np.asarray(then, dtype=np.float64), np.asarray(now, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return one.shape == other.shape and bool(np.allclose(one, other, rtol=0.0, atol=tolerance, equal_nan=True))


def _text_agrees(then: str, now: str, tolerance: float) -> bool:
    """Compare two texts word for word, and the numbers in them within the tolerance or their last printed digit."""
    if _NUMBER.sub("#", then) != _NUMBER.sub("#", now):
        return False
    pairs = zip(_NUMBER.finditer(then), _NUMBER.finditer(now), strict=True)
    return all(abs(float(one[0]) - float(other[0])) <= max(tolerance, _last_digit(one)) for one, other in pairs)


def _last_digit(number: "re.Match[str]") -> float:
    """Return the value of the last printed digit: rounding may move a number to the next one."""
    return 1.001 * 10.0 ** -len(number[1] or "")
