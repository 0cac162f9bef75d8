"""What all recorded runs did, added up in a file beside this one.

``python -m verification.fuzz --report`` prints it.
"""

import json
from collections.abc import Mapping
from typing import Any

from verification.fuzz.run import Run
from verification.fuzz.target import FOLDER
from verification.fuzz.targets import TARGETS

RECORD = FOLDER / "record.json"
HEAD = "| target | reads | seconds | executions | edges reached | kept inputs | found, and fixed |"


def load() -> dict[str, dict[str, Any]]:
    """Read the record."""
    if not RECORD.is_file():
        return {}
    kept: dict[str, dict[str, Any]] = json.loads(RECORD.read_text(encoding="utf-8"))
    return kept


def add(run: Run, seconds: int) -> None:
    """Add a run; a finding is named by a person, in ``found``, once it is understood."""
    kept = load()
    row = kept.setdefault(run.target, {"seconds": 0, "executions": 0, "coverage": 0, "found": []})
    row["seconds"] += seconds
    row["executions"] += run.executions
    row["coverage"] = max(row["coverage"], run.coverage)
    RECORD.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def table(kept: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """Write the record as Markdown."""
    kept = load() if kept is None else kept
    rows = [_row(name, kept.get(name, {})) for name in TARGETS]
    seconds, executions = (sum(row.get(name, 0) for row in kept.values()) for name in ("seconds", "executions"))
    total = f"| all | | {seconds} | {executions:,} | | {sum(map(_inputs, TARGETS))} | |"
    return "\n".join([HEAD, "|---|---|---|---|---|---|---|", *rows, total])


def _row(name: str, kept: Mapping[str, Any]) -> str:
    found = "; ".join(kept.get("found", [])) or "nothing"
    seconds, executions, coverage = (kept.get(key, 0) for key in ("seconds", "executions", "coverage"))
    return f"| {name} | {TARGETS[name].reads} | {seconds} | {executions:,} | {coverage} | {_inputs(name)} | {found} |"


def _inputs(name: str) -> int:
    return len(TARGETS[name].kept())
