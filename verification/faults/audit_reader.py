"""The audit read from the database's file, whether the service runs or not."""

import json
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from service.storage.samples.store import SampleStore
from verification.faults.verdict import Reported

TRANSITION, CLOSE = "gate.transition", "session.close"
BUSY_S = 20.0


class Ledger:
    """Reads one database, never writes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._shelf = SampleStore(path.parent / "samples")

    def newest(self) -> int:
        """Return the number of the newest audit row."""
        return int(self._rows("SELECT max(sequence) FROM audit")[0][0] or 0)

    def reported_since(self, sequence: int) -> list[Reported]:
        """What was written behind this row: reasons of transitions, ends of sessions, and other actions."""
        rows = self._rows("SELECT action, detail FROM audit WHERE sequence > ? ORDER BY sequence", sequence)
        return [one for action, detail in rows for one in _reported(str(action), json.loads(detail))]

    def first_outside_ns(self, session_id: str, from_ns: int, edge_mm: float) -> int | None:
        """When the first frame came, from this time on, whose signal lies beyond the edge."""
        for batch in self._shelf.batches(session_id):
            for received_ns, signal_mm in zip(
                batch["received_ns"].to_pylist(), batch["signal_mm"].to_pylist(), strict=True
            ):
                if received_ns >= from_ns and signal_mm is not None and abs(signal_mm) > edge_mm:
                    return int(received_ns)
        return None

    def _rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        end_s = time.monotonic() + BUSY_S
        while True:
            try:
                with closing(sqlite3.connect(f"file:{self._path}?mode=ro", uri=True, timeout=BUSY_S)) as database:
                    return database.execute(query, values).fetchall()
            except sqlite3.OperationalError:
                if time.monotonic() > end_s:
                    raise
                time.sleep(0.05)


def _reported(action: str, detail: dict[str, Any]) -> list[Reported]:
    now_ns = time.monotonic_ns()
    if action == TRANSITION:
        return [
            Reported(what=str(detail["reason"]), at_ns=int(detail["asserted_ns"] or detail["decided_ns"] or now_ns))
        ]
    if action == CLOSE:
        return [Reported(what=f"session {detail['status']}", at_ns=now_ns)]
    return [Reported(what=action, at_ns=now_ns)]
