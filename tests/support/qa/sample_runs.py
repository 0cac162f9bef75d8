"""Runs of QA as the service tells them, made up: for reports, trends and pages of tests."""

import math
from datetime import UTC, datetime, timedelta

from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.checks import CHECKS, checks_of
from engine.qa.results import QaCurve, QaFigure, QaKind, QaReport, QaSeries
from engine.qa.run import judge_all
from service.qa import schemas

NOON = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
EXPECTED = {"camera_distance_mm": 850.0, "camera_tilt_x_deg": 0.4, "camera_tilt_y_deg": -0.2}
BASELINE = QaBaseline(expected=EXPECTED)


def figures(kind=QaKind.DAILY, share=0.3, **values):
    """Figures that lie at this share of their warning; ``values`` are what is different, None is not measured."""
    made = []
    for check in checks_of(kind):
        zero = EXPECTED.get(check.code, check.expected or 0.0)
        value = values.get(check.code, zero + share * check.warn)
        made.append(QaFigure(code=check.code, value=value, detail="" if value is not None else "no plate was seen"))
    return made


def report(kind=QaKind.DAILY, share=0.3, series=(), baseline=BASELINE, **values):
    return QaReport(
        kind=kind, results=judge_all(kind, figures(kind, share, **values), QaBounds(), baseline), series=tuple(series)
    )


def sample_series():
    seconds = tuple(n / 10 for n in range(400))
    calls = tuple(5.0 * math.sin(2.0 * math.pi * s / 4.0) for s in seconds)
    seen = tuple(5.1 * math.sin(2.0 * math.pi * (s - 0.06) / 4.0) + 0.1 for s in seconds)
    return (
        QaSeries(
            code="plate_distance",
            title="Plate distance",
            x_label="time [s]",
            y_label="distance [mm]",
            curves=(QaCurve(name="mean", x=tuple(range(60)), y=tuple(850.2 + 0.1 * math.sin(n) for n in range(60))),),
        ),
        QaSeries(
            code="motion",
            title="Commanded and measured motion",
            x_label="time [s]",
            y_label="motion [mm]",
            curves=(QaCurve(name="commanded", x=seconds, y=calls), QaCurve(name="measured", x=seconds, y=seen)),
        ),
    )


def run_detail(kind=QaKind.DAILY, made=None, **changes):
    """A finished run as the API tells it."""
    made = report(kind) if made is None else made
    by_code = {check.code: check for check in CHECKS}
    results = [
        {
            **{name: getattr(one, name) for name in ("code", "value", "unit", "expected", "deviation", "uncertainty")},
            **{name: getattr(one, name) for name in ("warn", "fail", "detail")},
            "verdict": one.verdict.value,
            "title": by_code[one.code].title,
            "sidedness": by_code[one.code].sidedness.value,
        }
        for one in made.results
    ]
    series = [
        {
            **{name: getattr(one, name) for name in ("code", "title", "x_label", "y_label")},
            "curves": [{"name": curve.name, "x": list(curve.x), "y": list(curve.y)} for curve in one.curves],
        }
        for one in made.series
    ]
    base = {
        "id": "ab" * 16,
        "kind": kind.value,
        "status": "finished",
        "status_detail": "",
        "verdict": made.verdict.value,
        "operator": "A. Physicist",
        "site": "St. Example Hospital",
        "machine": "Linac 2",
        "is_simulated": False,
        "is_simulated_beam": True,
        "software": "0.1.0",
        "created_at": NOON,
        "ended_at": NOON + timedelta(minutes=4),
        "note": "",
        "calibration_sha256": "c0ffee" * 10 + "abcd",
        "baseline_number": 1,
        "results": results,
        "series": series,
        "sha256": "5ea1" * 16,
    }
    return schemas.QaRunDetail.model_validate(base | changes)


def trends(detail, runs=30):
    """A made-up history of each check of a run, which ends with the run itself."""
    made = []
    for order, one in enumerate(detail.results):
        items = []
        for number in range(runs):
            wave = 0.35 * math.sin(0.9 * number + order) + 0.3 * math.sin(0.23 * number + 2 * order)
            size = one.warn * (abs(wave) if one.sidedness == "at_most" else wave)
            is_last = number == runs - 1
            items.append(
                {
                    "run_id": "cd" * 16,
                    "kind": detail.kind,
                    "at": NOON - timedelta(days=runs - 1 - number),
                    "value": one.value if is_last else size + (one.expected or 0.0),
                    "expected": one.expected,
                    "deviation": one.deviation if is_last else size,
                    "warn": one.warn,
                    "fail": one.fail,
                    "verdict": one.verdict if is_last else "pass",
                }
            )
        made.append(
            schemas.QaTrend.model_validate(
                {
                    "check": one.code,
                    "title": one.title,
                    "unit": one.unit,
                    "sidedness": one.sidedness,
                    "items": items,
                }
            )
        )
    return made
