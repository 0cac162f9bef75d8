"""QA results as tables on standard output: the checks of a run, the list of runs, a trend, the baseline."""

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from service.qa.latency.schemas import CameraLatencyList
from service.qa.report.style import number
from service.qa.schemas import QaBaselineHistory, QaCheckList, QaResult, QaRun, QaRunDetail, QaTrend

PIPED_WIDTH = 150
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
ID_SIGNS = 8


def print_results(run: QaRunDetail) -> None:
    """Print every check of a run and then the verdict of the run."""
    table = _table(
        f"{run.kind.capitalize()} QA", ["check"], ["value", "expected", "deviation", "warning", "failure", "verdict"]
    )
    for one in run.results:
        table.add_row(*_result(one))
    console = _console()
    console.print(table)
    for one in run.results:
        if one.verdict != "pass" and one.detail:
            console.print(f"{one.title}: {one.detail}", markup=False)
    if run.is_simulated:
        console.print("SIMULATED: not a QA result of this site.")
    verdict = run.verdict or "fail"
    console.print(Text(f"{verdict.upper()}  run {run.id}", style=STYLES[verdict]))


def print_runs(runs: Sequence[QaRun]) -> None:
    """Print runs, newest first."""
    table = _table("", ["run", "began", "kind", "operator"], ["verdict"])
    for run in runs:
        # A service may be running it now, or was killed during it; the next start with the folder marks the latter.
        state = "not ended" if run.status == "running" else run.verdict or run.status
        note = " (simulated)" * run.is_simulated
        began = run.created_at.strftime("%Y-%m-%d %H:%M:%S UTC")
        table.add_row(run.id, began, f"{run.kind}{note}", escape(run.operator), _verdict(state))
    _console().print(table)


def print_trend(trend: QaTrend) -> None:
    """Print a check over runs, oldest first."""
    unit = f" [{trend.unit}]" if trend.unit else ""
    table = _table(
        f"{trend.title}{unit}", ["run", "began", "kind"], ["value", "deviation", "warning", "failure", "verdict"]
    )
    for one in trend.items:
        table.add_row(
            one.run_id[:ID_SIGNS],
            one.at.strftime("%Y-%m-%d %H:%M:%S UTC"),
            one.kind,
            number(one.value),
            number(one.deviation) if trend.sidedness == "absolute" else "",
            number(one.warn),
            number(one.fail),
            _verdict(one.verdict),
        )
    _console().print(table)


def print_checks(checks: QaCheckList) -> None:
    """Print the table of checks."""
    table = _table("", ["code", "check", "in", "source"], ["warning", "failure"])
    for one in checks.items:
        unit = f" {one.unit}" if one.unit else ""
        table.add_row(
            one.code, one.title, one.kinds[0], one.source, f"{number(one.warn)}{unit}", f"{number(one.fail)}{unit}"
        )
    _console().print(table)


def print_cameras(cameras: CameraLatencyList) -> None:
    """Print the newest latency of each camera and mode, and what clinical mode says of it."""
    table = _table(
        "", ["camera", "measured", "by", "mode"], ["median", "uncertain by", "slowest", "counted", "verdict"]
    )
    for one in cameras.items:
        times_ms = (one.median_ms, one.uncertainty_ms, one.worst_ms, one.counted_ms)
        table.add_row(
            escape(one.camera.identity),
            one.at.strftime("%Y-%m-%d"),
            escape(one.operator),
            one.camera.mode_text,
            *(number(value, "ms") for value in times_ms),
            _verdict(one.verdict),
        )
    console = _console()
    console.print(table)
    console.print(f"The site counts {cameras.configured_ms:g} ms; longest age {cameras.max_age_days:g} days.")
    for one in cameras.items:
        if one.refusal is not None:
            console.print(f"Clinical mode refuses to arm: {one.refusal}", markup=False)


def print_baseline(baseline: QaBaselineHistory) -> None:
    """Print the current baseline and the earlier ones."""
    table = _table("", ["no.", "set", "by", "reason"], ["expected"])
    for one in (baseline, *baseline.earlier):
        fixed = "never" if one.created_at is None else one.created_at.strftime("%Y-%m-%d %H:%M:%S UTC")
        expected = ", ".join(f"{name} {number(value)}" for name, value in one.expected.items())
        table.add_row(str(one.number), fixed, escape(one.set_by), escape(one.reason), expected)
    _console().print(table)


def _result(one: QaResult) -> tuple[str | Text, ...]:
    has_expected = one.sidedness == "absolute"
    value = number(one.value, one.unit) if one.value is not None else "not measured"
    return (
        one.title,
        value,
        number(one.expected) if has_expected else "",
        number(one.deviation) if has_expected else "",
        number(one.warn),
        number(one.fail),
        _verdict(one.verdict),
    )


def _verdict(word: str) -> Text:
    return Text(word.upper() if word in STYLES else word, style=STYLES.get(word, ""))


def _table(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(title=escape(title) or None, title_justify="left", show_edge=False)
    for name in left:
        table.add_column(name, overflow="fold")
    for name in right:
        table.add_column(name, justify="right", overflow="fold")
    return table


def _console() -> Console:
    return Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=PIPED_WIDTH)
