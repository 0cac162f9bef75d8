"""Writes the evaluation's report: results.json, one CSV per table, one PNG per figure, and one page with all."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from engine.core.files import write_whole
from engine.lab.evaluation.report.bench_tables import all_tables
from engine.lab.evaluation.report.figures import all_figures
from engine.lab.evaluation.report.page import Heading, page
from engine.lab.evaluation.runs.marks import Mark, marks_table, reach
from engine.lab.evaluation.runs.scored_run import ScoredRun
from engine.lab.evaluation.table import Table

RESULTS = "results.json"
RESULTS_SCHEMA = "tidegate.evaluation/1"


def write_report(
    scored: list[ScoredRun], out: Path, *, command: str, version: str, seed: int, settings: dict[str, object]
) -> tuple[list[Table], list[Mark]]:
    """Write the report to the folder ``out``; return the tables, marks first, and the marks."""
    marks = reach(scored)
    tables = [marks_table(marks), *all_tables(scored)]
    figures = all_figures(scored)
    heading = Heading(
        command=command,
        version=version,
        seed=seed,
        recordings=len(scored),
        frames=sum(len(one.outcome.timestamp_us) for one in scored),
        met=sum(mark.is_met for mark in marks),
        marks=len(marks),
    )
    results: dict[str, object] = {
        "schema": RESULTS_SCHEMA,
        "command": command,
        "version": version,
        "seed": seed,
        "settings": settings,
        "marks": [asdict(mark) | {"is_met": mark.is_met} for mark in marks],
        "tables": {table.name: table.to_json() for table in tables},
        "runs": {one.run.name: _run(one) for one in scored},
    }
    files = {f"{table.name}.csv": table.to_csv().encode() for table in tables}
    files |= {f"{picture.name}.png": picture.png for picture in figures}
    files["index.html"] = page(heading, tables, figures).encode()
    out.mkdir(parents=True, exist_ok=True)
    # Remove tables and figures of an earlier report that this one does not contain.
    outdated = _files_of(out / RESULTS) - set(files)
    results["files"] = sorted(files)
    for name, content in files.items():
        write_whole(out / name, content)
    write_whole(out / RESULTS, json.dumps(_finite(results), indent=1, allow_nan=False).encode())
    for name in outdated:
        (out / name).unlink(missing_ok=True)
    return tables, marks


def _run(one: ScoredRun) -> dict[str, object]:
    run = one.run
    return {
        **run.recipe,
        "group": run.group,
        "setting": run.setting,
        "frames": len(one.outcome.timestamp_us),
        "judged_frames": int(one.frames.sum()),
        "scores": {name: asdict(score) for name, score in one.scores.items()},
        "event_scores": {name: asdict(score) for name, score in one.event_scores.items()},
        "trust": asdict(one.trust),
        "notes": one.outcome.notes,
    }


def _finite(value: Any) -> Any:  # noqa: ANN401 (any JSON)
    """Replace NaN and infinity by null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _files_of(results: Path) -> set[str]:
    """Names of the files that an earlier report wrote here; empty if there was none."""
    try:
        names = json.loads(results.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {name for name in names if isinstance(name, str) and Path(name).name == name}
