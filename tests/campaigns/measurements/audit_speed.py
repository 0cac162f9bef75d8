"""How fast rows are added, walked and exported.

Run: ``python -m tests.campaigns.measurements.audit_speed --rows 100000``.
"""

import argparse
import resource
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.check import check_whole
from service.storage.audit.formats.export import ExportFormat, ExportRequest, write_export
from service.storage.database.engine import Database

ROWS_A_TRANSACTION = 200
TRANSITION = {
    "from_state": "dwell",
    "to_state": "beam_on",
    "reason": None,
    "operator": None,
    "detail": "",
    "number": 17,
    "frame_index": 512,
    "captured_us": 17_083_000,
    "received_ns": 1_999_999_997,
    "decided_ns": 2_000_000_000,
    "asserted_ns": 2_000_000_003,
    "captured_ns": 1_975_000_000,
    "latency_ms": 25.2,
}


def add(database: Database, rows: int) -> None:
    for start in range(0, rows, ROWS_A_TRANSACTION):
        with database.write() as db:
            for number in range(start, min(rows, start + ROWS_A_TRANSACTION)):
                detail = {**TRANSITION, "frame_index": number}
                audit.append(db, Event(actor="tidegate", action="gate.transition", session_id="5" * 32, detail=detail))


def tell(what: str, rows: int, work: Callable[[], object]) -> None:
    began_s = time.perf_counter()
    work()
    seconds = time.perf_counter() - began_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    line = f"{what:<22}{rows:>9} rows {seconds:>8.1f} s {rows / seconds:>9.0f} rows/s {peak_mb:>7.0f} MB peak"
    sys.stdout.write(f"{line}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=100_000, choices=range(1, 10_000_001), metavar="N")
    rows = parser.parse_args().rows
    with tempfile.TemporaryDirectory() as folder, closing(Database(Path(folder) / "tidegate.db")) as database:
        database.migrate()
        file = AnchorFile(Path(folder) / "anchors.jsonl")
        tell("append, 200 at once", rows, lambda: add(database, rows))
        tell("append, 1 at once", 500, lambda: [add(database, 1) for _ in range(500)])
        tell("verify", rows, lambda: check_whole(database, file))
        for form in ExportFormat:
            request = ExportRequest(format=form)
            tell(
                f"export {form.value}", rows, lambda request=request: deque(write_export(database, request, site=""), 0)
            )


if __name__ == "__main__":
    main()
