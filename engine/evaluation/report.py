"""Writes what the bench found: results.json, a CSV a table, a PNG a figure, and one page with all of it."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from engine.evaluation.bench_tables import all_tables
from engine.evaluation.figures import all_figures
from engine.evaluation.judged import Judged
from engine.evaluation.marks import Mark, marks_table, reach
from engine.evaluation.page import Heading, page
from engine.evaluation.tables import Table

RESULTS = "results.json"
RESULTS_SCHEMA = "tidegate.evaluation/1"


def write_report(
    judged: list[Judged], out: Path, *, command: str, version: str, seed: int, settings: dict[str, object]
) -> tuple[list[Table], list[Mark]]:
    """Write everything to ``out``; return the tables, marks first, and the marks."""
    marks = reach(judged)
    tables = [marks_table(marks), *all_tables(judged)]
    figures = all_figures(judged)
    heading = Heading(
        command=command,
        version=version,
        seed=seed,
        recordings=len(judged),
        frames=sum(len(one.outcome.timestamp_us) for one in judged),
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
        "runs": {one.run.name: _run(one) for one in judged},
    }
    files = {f"{table.name}.csv": table.to_csv().encode() for table in tables}
    files |= {f"{picture.name}.png": picture.png for picture in figures}
    files["index.html"] = page(heading, tables, figures).encode()
    out.mkdir(parents=True, exist_ok=True)
    # A table or figure of an earlier, larger run would stand beside a page that knows nothing of it.
    outdated = _files_of(out / RESULTS) - set(files)
    results["files"] = sorted(files)
    for name, content in files.items():
        _write(out / name, content)
    _write(out / RESULTS, json.dumps(_finite(results), indent=1, allow_nan=False).encode())
    for name in outdated:
        (out / name).unlink(missing_ok=True)
    return tables, marks


def _run(one: Judged) -> dict[str, object]:
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
    """Return the same with null for numbers that JSON has no word for."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write(path: Path, content: bytes) -> None:
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _files_of(results: Path) -> set[str]:
    """Names of the files an earlier report wrote here; none where there was none."""
    try:
        names = json.loads(results.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {name for name in names if isinstance(name, str) and Path(name).name == name}
