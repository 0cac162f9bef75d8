"""PDF report of a finished QA run: one or two A4 pages, the same bytes for the same run.

Each verdict is a word as well as a colour, and a failure is the darkest mark on the page, so the report is legible on a
black-and-white printer.
"""

from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from service.core.typeset import typeset
from service.qa.report.panels import series_panel, trend_panel
from service.qa.report.style import DASH, LOOKS, number
from service.qa.schemas import QaResult, QaRunDetail, QaTrend

LONGEST_DETAIL, LONGEST_NOTE = 120, 95
MOST_REMARKS, MOST_TRENDS, MOST_SERIES = 8, 16, 6
KEY_CHECKS = (
    *("camera_distance_mm", "camera_tilt_x_deg", "camera_tilt_y_deg", "plate_noise_mm"),
    *("plate_drift_mm", "plate_flatness_mm", "motion_offset_mm", "motion_error_mm", "motion_lag_ms"),
    *("gate_mean_delay_ms", "gate_delay_difference_ms", "duty_cycle_change_percent"),
    *("treatment_beam_off_ms", "hold_to_beam_off_ms", "beam_readback_off_ms", "fail_safe_hold_ms"),
)
SIMULATED = "SIMULATED FROM END TO END: a virtual plate, phantom and beam line. Counts for nothing."


def report_pdf(run: QaRunDetail, trends: Sequence[QaTrend]) -> bytes:
    """Return the PDF of a run with the trends of its checks."""
    document, made_at = report_document(run, trends), run.ended_at or run.created_at
    return typeset("service.qa.report", "report.typ", document, made_at=made_at, form="pdf")


def report_document(run: QaRunDetail, trends: Sequence[QaTrend]) -> dict[str, Any]:
    """Return what the template sets: words, rows of cells, and panels."""
    counts = {verdict: sum(one.verdict == verdict for one in run.results) for verdict in LOOKS}
    seal = f"run {run.id} · sha256 {(run.sha256 or '')[:12]} · Tidegate {run.software}"
    return {
        "date": _date(run.ended_at or run.created_at),
        "title": f"{run.kind.capitalize()} QA",
        "place": " · ".join(part for part in (run.site, run.machine) if part) or "site and machine not named",
        "verdict": run.verdict or "fail",
        "looks": {verdict: asdict(look) for verdict, look in LOOKS.items()},
        "facts": [
            ("Operator", _cut(run.operator, 26)),
            ("Began, UTC", _moment(run.created_at)),
            ("Ended, UTC", _moment(run.ended_at)),
            ("Beam line", "SIMULATED" if run.is_simulated_beam else "the site's"),
            ("Calibration", (run.calibration_sha256 or DASH)[:12]),
            ("Baseline", "none fixed" if run.baseline_number is None else f"no. {run.baseline_number}"),
        ],
        "counts": f"{len(run.results)} checks: " + ", ".join(f"{counts[verdict]} {verdict}" for verdict in counts),
        "note": f"Note: {_cut(run.note, LONGEST_NOTE)}" if run.note else "",
        "simulated": SIMULATED if run.is_simulated else "",
        "checks": [_row(one) for one in run.results],
        "remarks": [f"{title}: {_cut(detail, LONGEST_DETAIL)}" for title, detail in _remarks(run)],
        "series": [series_panel(one) for one in run.series[:MOST_SERIES]],
        "trends": [trend_panel(one) for one in _key_trends(trends)],
        "foot": f"{seal} · research and commissioning only, not cleared for clinical use",
    }


def _row(one: QaResult) -> dict[str, Any]:
    """Return a check's cells: title, value, expected value, deviation and bounds, and its verdict."""
    is_absolute = one.sidedness == "absolute"
    sign = "\N{PLUS-MINUS SIGN}" if is_absolute else ""
    value = "not measured" if one.value is None else number(one.value, one.unit)
    if one.uncertainty is not None and one.value is not None:
        value = f"{number(one.value)} \N{PLUS-MINUS SIGN} {number(one.uncertainty)} {one.unit}".strip()
    cells = [
        one.title,
        value,
        number(one.expected) if is_absolute else "",
        number(one.deviation) if is_absolute else "",
        f"{sign}{number(one.warn)}",
        f"{sign}{number(one.fail)}",
    ]
    return {"cells": cells, "verdict": one.verdict}


def _remarks(run: QaRunDetail) -> list[tuple[str, str]]:
    return [(one.title, one.detail) for one in run.results if one.verdict != "pass" and one.detail][:MOST_REMARKS]


def _key_trends(trends: Sequence[QaTrend]) -> list[QaTrend]:
    by_code = {trend.check: trend for trend in trends}
    keys = [code for code in KEY_CHECKS if code in by_code]
    others = [code for code in by_code if code not in keys]
    return [by_code[code] for code in [*keys, *others][:MOST_TRENDS]]


def _moment(at: datetime | None) -> str:
    return DASH if at is None else at.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S")


def _date(at: datetime) -> tuple[int, int, int]:
    day = at.astimezone(UTC)
    return day.year, day.month, day.day


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"
