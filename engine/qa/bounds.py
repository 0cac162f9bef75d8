"""What a site has decided: its bounds, where they are not the table's, and what its camera's place should read.

A site may tighten a bound as far as it likes and widen it as far as the check allows, never further.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from engine.errors import InvalidValueError
from engine.qa.checks import CHECKS, check_of
from engine.qa.results import QaBound, QaCheck

BASELINE_BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "camera_distance_mm": (300.0, 3000.0),
        "camera_tilt_x_deg": (-45.0, 45.0),
        "camera_tilt_y_deg": (-45.0, 45.0),
    }
)
"""What a baseline is fixed for, by the check's code, and within what."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QaBounds:
    """The bounds of every check: the site's where ``chosen`` has them, the table's else."""

    chosen: Mapping[str, QaBound] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse bounds of no check, and those that are no bounds or wider than the check allows."""
        for code, bound in self.chosen.items():
            check_bound(check_of(code), bound)

    def of(self, code: str) -> QaBound:
        """Return a check's bounds; raise InvalidValueError where there is no such check."""
        check = check_of(code)
        return self.chosen.get(code) or QaBound(warn=check.warn, fail=check.fail)


@dataclass(frozen=True, slots=True, kw_only=True)
class QaBaseline:
    """What was read when the site was commissioned, by the check's code; a check that is not in it has none yet."""

    expected: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what no baseline is fixed for, and what cannot be."""
        for code, value in self.expected.items():
            if code not in BASELINE_BOUNDS:
                raise InvalidValueError(f"baseline.{code}", value, f"of one of {', '.join(BASELINE_BOUNDS)}")
            low, high = BASELINE_BOUNDS[code]
            _check_number(f"baseline.{code}", value, low, high)

    def of(self, code: str) -> float | None:
        """Return what a check should read, None where nothing was fixed."""
        return self.expected.get(code)


def check_bound(check: QaCheck, bound: QaBound) -> None:
    """Refuse bounds that are no numbers, wider than the check allows, or the wrong way round."""
    _check_number(f"{check.code}.fail", bound.fail, 0.0, check.most)
    _check_number(f"{check.code}.warn", bound.warn, 0.0, check.most)
    if bound.warn > bound.fail:
        raise InvalidValueError(f"{check.code}.warn", bound.warn, f"at most {check.code}.fail ({bound.fail:g})")


def all_bounds() -> Mapping[str, QaBound]:
    """Return the table's bounds, by the check's code."""
    return {check.code: QaBound(warn=check.warn, fail=check.fail) for check in CHECKS}


def _check_number(name: str, value: object, low: float, high: float) -> None:
    # Written so that NaN fails: every comparison with it is false.
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not is_number or not low <= value <= high:  # type: ignore[operator]
        raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
