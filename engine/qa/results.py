"""Values of QA: a check, its measured figure, its bounds, the verdict, and the report of a run.

`judge` is the only place where a figure is compared with bounds. A figure that could not be measured fails, with the
reason in its detail: QA that was not done is not passed.
"""

import enum
import math
from collections.abc import Iterable
from dataclasses import dataclass

from engine.core.errors import InvalidValueError


class QaKind(enum.StrEnum):
    """Extent of a run; monthly QA includes the daily checks, annual QA the monthly ones, a latency run neither."""

    DAILY = "daily"
    MONTHLY = "monthly"
    ANNUAL = "annual"
    LATENCY = "latency"


class QaNeed(enum.StrEnum):
    """Equipment that a check is measured with; also the stage of the run that measures it."""

    PLATE = "plate"
    PHANTOM = "phantom"
    BEAM = "beam"
    CAMERA = "camera"


class QaVerdict(enum.StrEnum):
    """Outcome of a check or of a run."""

    PASS = "pass"  # noqa: S105 - a verdict, no password
    WARN = "warn"
    FAIL = "fail"

    @classmethod
    def worst(cls, verdicts: Iterable["QaVerdict"]) -> "QaVerdict":
        """Return the worst verdict; FAIL if there is none."""
        order = tuple(cls)
        return max(verdicts, key=order.index, default=cls.FAIL)


class Sidedness(enum.StrEnum):
    """Which quantity of a figure is compared with the bounds."""

    ABSOLUTE = "absolute"
    """The absolute deviation from the expected value."""

    AT_MOST = "at_most"
    """The figure itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QaCheck:
    """One row of the table of checks.

    Attributes
    ----------
    code
        Its stable name in files, settings, the API and the database.
    method
        How it is measured, in a sentence.
    kinds
        Kinds of run that include this check.
    expected
        Expected value of an `Sidedness.ABSOLUTE` check; None for `Sidedness.AT_MOST`, and where the site's baseline
        gives it (``has_baseline``).
    warn, fail
        Default bounds in ``unit``: a figure beyond ``warn`` warns, beyond ``fail`` fails.
    most
        Widest ``fail`` that a site may choose.
    source
        Origin of the bounds: task group report and its number, or the system's own argument.
    is_optional
        Whether a run without a figure is judged without this check: for an input that a site may not have.
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
    is_optional: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class QaBound:
    """A site's bounds for one check."""

    warn: float
    fail: float


@dataclass(frozen=True, slots=True, kw_only=True)
class QaFigure:
    """One measured figure; ``value`` is None where it could not be measured, and ``detail`` gives the reason.

    ``uncertainty`` is the figure's standard error in its unit, None where it has none to speak of.
    """

    code: str
    value: float | None
    detail: str = ""
    uncertainty: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QaResult:
    """A figure with its verdict.

    Attributes
    ----------
    expected
        Expected value; None for an `Sidedness.AT_MOST` check, and where the site has no baseline.
    deviation
        Quantity that is compared with the bounds: value less expected value, or the value of an
        `Sidedness.AT_MOST` check; None where it is unknown.
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
    """One curve of a plot; ``x`` and ``y`` have equal lengths and hold no NaN."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class QaSeries:
    """One plot of a report; ``code`` is stable, the axis labels include the units."""

    code: str
    title: str
    x_label: str
    y_label: str
    curves: tuple[QaCurve, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class QaReport:
    """Results and plots of one run; the caller adds operator and time."""

    kind: QaKind
    results: tuple[QaResult, ...]
    series: tuple[QaSeries, ...] = ()

    @property
    def verdict(self) -> QaVerdict:
        """Worst verdict of all checks."""
        return QaVerdict.worst(result.verdict for result in self.results)


def judge(figure: QaFigure, check: QaCheck, bound: QaBound, expected: float | None = None) -> QaResult:
    """Compare a figure with a check's bounds.

    Parameters
    ----------
    expected
        The site's baseline in the check's unit; only used where the check ``has_baseline``.

    Raises
    ------
    InvalidValueError
        The figure belongs to another check.
    """
    if figure.code != check.code:
        raise InvalidValueError("figure", figure.code, f"a figure of {check.code}")
    expected_value = expected if check.has_baseline else check.expected
    deviation, shortcoming = _deviation(figure, check, expected_value)
    return QaResult(
        code=check.code,
        value=figure.value if _is_number(figure.value) else None,
        unit=check.unit,
        expected=expected_value,
        deviation=deviation,
        warn=bound.warn,
        fail=bound.fail,
        verdict=QaVerdict.FAIL if deviation is None else _verdict(deviation, check, bound),
        detail="; ".join(part for part in (shortcoming, figure.detail) if part),
        uncertainty=figure.uncertainty,
    )


def _deviation(figure: QaFigure, check: QaCheck, expected_value: float | None) -> tuple[float | None, str]:
    """Return the quantity to compare with the bounds, or None and the reason why there is none."""
    value = figure.value
    if value is None:
        return None, "not measured"
    if not math.isfinite(value):
        return None, f"not measured: {value}"
    if check.sidedness is Sidedness.AT_MOST:
        return value, ""
    if expected_value is None:
        return None, "no baseline was fixed to compare with"
    return value - expected_value, ""


def _verdict(deviation: float, check: QaCheck, bound: QaBound) -> QaVerdict:
    size = abs(deviation) if check.sidedness is Sidedness.ABSOLUTE else deviation
    # Written so that NaN fails: every comparison with it is false.
    if not size <= bound.fail:
        return QaVerdict.FAIL
    return QaVerdict.PASS if size <= bound.warn else QaVerdict.WARN


def _is_number(value: float | None) -> bool:
    return value is not None and math.isfinite(value)
