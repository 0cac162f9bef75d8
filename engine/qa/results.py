"""The words of QA: a check, a figure measured for it, the bounds it is judged by, and the report of a run.

No number is judged anywhere else. What could not be measured is a fail that says why: QA not done is not passed.
"""

import enum
import math
from collections.abc import Iterable
from dataclasses import dataclass

from engine.errors import InvalidValueError


class QaKind(enum.StrEnum):
    """How much is checked; each holds all of the one before."""

    DAILY = "daily"
    MONTHLY = "monthly"
    ANNUAL = "annual"


class QaNeed(enum.StrEnum):
    """What a check is measured with, and the stage of a run at which that is done."""

    PLATE = "plate"
    PHANTOM = "phantom"
    BEAM = "beam"


class QaVerdict(enum.StrEnum):
    """How a check, or a run, came out."""

    PASS = "pass"  # noqa: S105 - a verdict, no password
    WARN = "warn"
    FAIL = "fail"

    @classmethod
    def worst(cls, verdicts: Iterable["QaVerdict"]) -> "QaVerdict":
        """Return the worst of them; nothing checked is a fail."""
        order = tuple(cls)
        return max(verdicts, key=order.index, default=cls.FAIL)


class Sidedness(enum.StrEnum):
    """What of a figure is held against the bounds."""

    ABSOLUTE = "absolute"
    """How far it is from what is expected, whichever way."""

    AT_MOST = "at_most"
    """The figure itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QaCheck:
    """One thing that is checked.

    Attributes
    ----------
    code
        Its stable name in files, settings, the API and the database.
    method
        How it is measured, in a sentence.
    kinds
        In which runs.
    expected
        What an absolute check is held against; None for one at most, and where the site's baseline says it.
    warn, fail
        The bounds unless a site chooses its own: a figure beyond ``warn`` warns, beyond ``fail`` fails.
    most
        Widest ``fail`` a site may choose.
    source
        Where the bounds come from.
    """

    code: str
    title: str
    unit: str
    method: str
    needs: QaNeed
    kinds: tuple[QaKind, ...]
    sidedness: Sidedness
    warn: float
    fail: float
    most: float
    source: str
    expected: float | None = None
    has_baseline: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class QaBound:
    """A site's bounds for one check."""

    warn: float
    fail: float


@dataclass(frozen=True, slots=True, kw_only=True)
class QaFigure:
    """One measured figure; ``value`` is None where it could not be measured, and ``detail`` says why.

    ``uncertainty`` is the figure's standard error in its unit, None where it has none to speak of.
    """

    code: str
    value: float | None
    detail: str = ""
    uncertainty: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QaResult:
    """A figure, judged.

    Attributes
    ----------
    expected
        What it is held against; None for a check at most, and where the site has fixed no baseline.
    deviation
        What is held against the bounds: how far the value is from what is expected, with its sign, or the value.
    """

    code: str
    value: float | None
    unit: str
    expected: float | None
    deviation: float | None
    warn: float
    fail: float
    verdict: QaVerdict
    detail: str
    uncertainty: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QaCurve:
    """Points of a plot; ``x`` and ``y`` are as long as each other, NaN-free."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class QaSeries:
    """What a plot of a report shows; ``code`` is stable, the axes carry their units."""

    code: str
    title: str
    x_label: str
    y_label: str
    curves: tuple[QaCurve, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class QaReport:
    """A whole run; who did it and when is its caller's to say."""

    kind: QaKind
    results: tuple[QaResult, ...]
    series: tuple[QaSeries, ...] = ()

    @property
    def verdict(self) -> QaVerdict:
        """The worst of all checks."""
        return QaVerdict.worst(result.verdict for result in self.results)


def judge(figure: QaFigure, check: QaCheck, bound: QaBound, expected: float | None = None) -> QaResult:
    """Hold a figure against bounds.

    Parameters
    ----------
    expected
        The site's baseline, for a check that has one.

    Raises
    ------
    InvalidValueError
        The figure is another check's.
    """
    if figure.code != check.code:
        raise InvalidValueError("figure", figure.code, f"a figure of {check.code}")
    against = expected if check.has_baseline else check.expected
    deviation, shortcoming = _deviation(figure, check, against)
    return QaResult(
        code=check.code,
        value=figure.value if _is_number(figure.value) else None,
        unit=check.unit,
        expected=against,
        deviation=deviation,
        warn=bound.warn,
        fail=bound.fail,
        verdict=QaVerdict.FAIL if deviation is None else _verdict(deviation, check, bound),
        detail="; ".join(part for part in (shortcoming, figure.detail) if part),
        uncertainty=figure.uncertainty,
    )


def _deviation(figure: QaFigure, check: QaCheck, against: float | None) -> tuple[float | None, str]:
    """Return what is held against the bounds, or None and why there is nothing to hold."""
    value = figure.value
    if value is None:
        return None, "not measured"
    if not math.isfinite(value):
        return None, f"not measured: {value}"
    if check.sidedness is Sidedness.AT_MOST:
        return value, ""
    if against is None:
        return None, "no baseline was fixed to compare with"
    return value - against, ""


def _verdict(deviation: float, check: QaCheck, bound: QaBound) -> QaVerdict:
    size = abs(deviation) if check.sidedness is Sidedness.ABSOLUTE else deviation
    # Written so that what is no number fails.
    if not size <= bound.fail:
        return QaVerdict.FAIL
    return QaVerdict.PASS if size <= bound.warn else QaVerdict.WARN


def _is_number(value: float | None) -> bool:
    return value is not None and math.isfinite(value)
