"""Writes the evaluation's report: results.json, one CSV per table, one PNG per figure, and one page with all."""

import base64
import html
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from engine.core.files import write_whole
from lab.evaluation.report.bench_tables import all_tables, on_usual_sensor
from lab.evaluation.report.figures import all_figures
from lab.evaluation.report.more_figures import Picture
from lab.evaluation.runs.marks import Mark, marks_table, reach
from lab.evaluation.runs.scores import ScoredRun
from lab.evaluation.table import Table

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2327; --soft: #5b6770; --line: #d9dee2; --back: #fbfbfa; --card: #fff;
  --good: #0f766e; --bad: #b42318; }
# The report page: one HTML file with all tables and figures, without other files or network access.
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9eb; --soft: #9aa5ad; --line: #333b41; --back: #14181b;
  --card: #1b2024; --good: #4cc5b8; --bad: #ff8a7a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1120px; padding: 2rem 1.25rem 4rem; background: var(--back); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { margin: 0; font-size: 1.7rem; } h2 { margin: 3rem 0 .75rem; font-size: 1.25rem; }
h3 { margin: 1.75rem 0 .4rem; font-size: 1rem; }
p { margin: .4rem 0; max-width: 75ch; } .soft, .command { color: var(--soft); font-size: .87rem; }
code { white-space: nowrap; font: .85rem ui-monospace, monospace; }
nav a { margin-right: 1rem; color: inherit; }
.scroll { overflow-x: auto; width: fit-content; max-width: 100%;
  border: 1px solid var(--line); border-radius: 6px; background: var(--card); }
table { border-collapse: collapse; min-width: 60%; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .6rem; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
thead th { font-weight: 600; color: var(--soft); white-space: normal; }
tbody th { font-weight: 500; white-space: nowrap; } tbody tr:last-child > * { border-bottom: 0; }
.n { text-align: right !important; } td { white-space: nowrap; } tr.failed > * { color: var(--bad); font-weight: 600; }
figure { margin: 1rem 0 2rem; } img { max-width: 100%; display: block; background: #fff; border-radius: 6px;
  border: 1px solid var(--line); padding: .4rem; }
figcaption { margin-top: .4rem; color: var(--soft); font-size: .87rem; max-width: 85ch; }
.verdict { font-weight: 600; } .met { color: var(--good); } .missed { color: var(--bad); }
"""
_HOW = """<h2 id=how>Method</h2>
<p>All methods measure the same frames of the same recording. Motion is the depth of the reference frame minus the
current depth, positive towards the camera. Each method uses its own first measured frame as reference, the oracle
uses ours; that frame's noise is part of every later error. All methods are scored on the same frames: those after
the last method has finished training. An error is the absolute difference to the true motion of the skin at the
region's grid points: of 700 cells of 10 x 10 points for the whole region, of single points for the five.</p>
<p>The plain method is trained on a hundred frames spread over 15 s, as at the article's 6.7 frames per second. It
applies the mode filter and the bilateral filter to those frames only, keeps three components, and sets a hole to the
mean afterwards. The oracle is given the true spatial modes, the true position of every grid point, the depth of each
reading before rounding, and the sensor's constant misfit; it fits only the modes' weights to each noisy frame. A
method that has to learn the modes can hardly do better, unless it averages over time.</p>
<p>The virtual sensor has the quantisation, correlated noise, holes, flicker, jumps, scale error and warm-up drift
measured on real units. It is still a model: these figures describe the method with such a sensor, not a particular
camera.</p>"""
RESULTS = "results.json"
RESULTS_SCHEMA = "tidegate.evaluation/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Heading:
    """Summary at the top of the page: the command, its settings, and the number of targets met."""

    command: str
    version: str
    seed: int
    recordings: int
    frames: int
    met: int
    marks: int


def page(heading: Heading, tables: list[Table], figures: list[Picture]) -> str:
    """Return the page as HTML."""
    missed = heading.marks - heading.met
    verdict = f"{heading.met} of {heading.marks} marks met" if missed else f"All {heading.marks} marks met"
    parts = [
        "<!doctype html><html lang=en><head><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>Tidegate: accuracy of the measurement</title><style>{_STYLE}</style></head><body><main>",
        "<h1>Accuracy of the measurement</h1>",
        "<p>Accuracy of Tidegate's motion measurement on virtual volunteers, whose true motion is known, compared with "
        "the article's figures (Wijenayake and Park, Sensors 2017, 17, 1840), with a plain implementation of the "
        "article on the same frames and an oracle that has each body's true motion and only the sensor's noise.</p>",
        f'<p class="verdict {"missed" if missed else "met"}">{verdict}.</p>',
        f"<p class=soft>{heading.recordings} recordings, {heading.frames} depth frames, seed {heading.seed}, Tidegate "
        f"{html.escape(heading.version)}. Printed by <code>{html.escape(heading.command)}</code></p>",
        '<nav aria-label="Sections"><a href="#how">Method</a><a href="#tables">Tables</a>'
        '<a href="#figures">Figures</a></nav>',
        _HOW,
        "<h2 id=tables>Tables</h2>",
        *(_table(table, heading.command) for table in tables),
        "<h2 id=figures>Figures</h2>",
        *(_figure(picture) for picture in figures),
        "</main></body></html>",
    ]
    return "\n".join(parts)


def _table(table: Table, command: str) -> str:
    note = f"<p class=soft>{html.escape(table.note)}</p>" if table.note else ""
    printed = f"<p class=command>Printed by <code>{html.escape(command)}</code>; in {table.name}.csv.</p>"
    title = f"<h3 id={table.name}>{html.escape(table.title)}</h3>"
    return f'<section>{title}<div class="scroll" tabindex="0">{table.to_html()}</div>{note}{printed}</section>'


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    alt = html.escape(f"{picture.title}. {picture.note}", quote=True)
    return (
        f"<figure id={picture.name}><h3>{html.escape(picture.title)}</h3>"
        f'<img alt="{alt}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(picture.note)}</figcaption></figure>"
    )


def write_report(
    scored: list[ScoredRun], out: Path, *, command: str, version: str, seed: int, settings: dict[str, object]
) -> tuple[list[Table], list[Mark]]:
    """Write the report to the folder ``out``; return the tables, marks first, and the marks."""
    marks = reach(scored)
    tables = [marks_table(marks), *all_tables(scored)]
    figures = all_figures(on_usual_sensor(scored))
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
        "whole_scores": {name: asdict(score) for name, score in one.whole_scores.items()},
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
