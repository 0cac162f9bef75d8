"""A site's QA settings: its own bounds, and the baseline of its camera's position.

A site may tighten a bound without limit and widen it up to the check's ``most``.

QA figures without a value: the checks of a stage that could not be measured.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from engine.core.bounds import check_number
from engine.core.errors import InvalidValueError
from engine.qa.checks import CHECKS, check_of
from engine.qa.results import QaBound, QaCheck, QaFigure, QaNeed

BASELINE_BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "camera_distance_mm": (300.0, 3000.0),
        "camera_tilt_x_deg": (-45.0, 45.0),
        "camera_tilt_y_deg": (-45.0, 45.0),
    }
)
"""Checks that have a site baseline, by code, and the range of its values (mm, deg)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QaBounds:
    """Bounds of every check: ``chosen`` by the site, by the check's code, otherwise the table's defaults."""

    chosen: Mapping[str, QaBound] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate each chosen bound with `check_bound`; an unknown code raises InvalidValueError."""
        for code, bound in self.chosen.items():
            check_bound(check_of(code), bound)

    def of(self, code: str) -> QaBound:
        """Return a check's bounds; raise InvalidValueError if the code is unknown."""
        check = check_of(code)
        return self.chosen.get(code) or QaBound(warn=check.warn, fail=check.fail)


@dataclass(frozen=True, slots=True, kw_only=True)
class QaBaseline:
    """Values measured at commissioning, by the check's code; a check without an entry has no baseline yet."""

    expected: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise InvalidValueError for a check without baseline and for a value out of `BASELINE_BOUNDS`."""
        for code, value in self.expected.items():
            if code not in BASELINE_BOUNDS:
                raise InvalidValueError(f"baseline.{code}", value, f"a baseline of {', '.join(BASELINE_BOUNDS)}")
            low, high = BASELINE_BOUNDS[code]
            check_number(f"baseline.{code}", value, low, high)

    def of(self, code: str) -> float | None:
        """Return a check's baseline, None if it has none."""
        return self.expected.get(code)


def check_bound(check: QaCheck, bound: QaBound) -> None:
    """Raise InvalidValueError unless 0 <= warn <= fail <= the check's ``most``."""
    check_number(f"{check.code}.fail", bound.fail, 0.0, check.most)
    check_number(f"{check.code}.warn", bound.warn, 0.0, check.most)
    if bound.warn > bound.fail:
        raise InvalidValueError(f"{check.code}.warn", bound.warn, f"at most {check.code}.fail ({bound.fail:g})")


def not_measured(need: QaNeed, reason: str) -> list[QaFigure]:
    """Return one figure with ``value=None`` and the reason as its detail for every check of that stage."""
    checks = (check for check in CHECKS if check.needs is need and not check.is_optional)
    return [QaFigure(code=check.code, value=None, detail=reason) for check in checks]
