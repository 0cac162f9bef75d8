"""A database of a million audit rows as revision 0005 left it, brought to this version's; and its backup, restored.

    python -m tests.campaigns.measurements.million_rows --rows 1000000 [--samples 100000] [--database
    sqlite|postgresql] [--out FOLDER]

Prints what it took: rows, seconds, the process's peak memory before and after. Exit 1 where a chain does not verify.
"""

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import typer
from sqlalchemy import URL, Connection, MetaData, insert, text

from service.storage import audit
from service.storage.audit.chain import GENESIS_HASH, Link, canonical_json, seal
from service.storage.audit.verification import head_sequence
from service.storage.backup.archive import opened
from service.storage.backup.backup import make_backup
from service.storage.backup.restore import Target, restore
from service.storage.database.base import utc_text
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from tests.support.database.backups import Silent, source_of
from tests.support.database.postgres import PostgresServer

OLD = "0005"
PIECE = 5000
FRAMES_A_SESSION = 10_000
FIRST = datetime(2026, 1, 1, tzinfo=UTC)
KIB = 1024


@dataclass(slots=True)
class Report:
    """What was done, how long it took, and how far memory went."""

    lines: list[str] = field(default_factory=list)

    @contextmanager
    def timed(self, what: str, rows: int) -> Iterator[None]:
        """Time one step, and print it."""
        began_s, before_mb = time.monotonic(), _peak_mb()
        yield
        seconds = time.monotonic() - began_s
        line = f"| {what} | {rows:,} | {seconds:.1f} | {rows / seconds:,.0f} | {before_mb:.0f} -> {_peak_mb():.0f} |"
        self.lines.append(line)
        typer.echo(line)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIB


def links(rows: int) -> Iterator[Link]:
    """Seal a chain of rows as sessions leave them."""
    previous = GENESIS_HASH
    for number in range(1, rows + 1):
        session_id = f"{number // 500:032x}"
        detail = {
            "from": "hold",
            "to": "dwell",
            "reason": None,
            "frame_index": number,
            "decided_ns": number * 33_000_000,
        }
        bare = Link(
            sequence=number,
            at=utc_text(FIRST + timedelta(milliseconds=100 * number)),
            actor="tidegate",
            action="gate.transition",
            outcome="done",
            session_id=session_id,
            detail=canonical_json(detail),
            previous_hash=previous,
            hash="",
        )
        previous = seal(bare)
        yield bare._replace(hash=previous)


def fill(connection: Connection, rows: int, samples: int) -> None:
    """Put audit rows and samples into tables of revision 0005."""
    tables = MetaData()
    tables.reflect(connection)
    piece: list[dict[str, object]] = []
    for link in links(rows):
        piece.append(link._asdict())
        if len(piece) == PIECE:
            connection.execute(insert(tables.tables["audit"]), piece)
            piece.clear()
    if piece:
        connection.execute(insert(tables.tables["audit"]), piece)
    _fill_samples(connection, tables, samples)


def _fill_samples(connection: Connection, tables: MetaData, samples: int) -> None:
    at = utc_text(FIRST)
    connection.execute(
        insert(tables.tables["calibrations"]),
        {"id": "c", "sha256": "h", "camera": "cam", "document": "{}", "uploaded_by": "me", "created_at": at},
    )
    names = ("patient_reference", "plan_id", "fraction_id", "operator")
    for first in range(0, samples, FRAMES_A_SESSION):
        session = dict.fromkeys(names, "x") | dict.fromkeys(("source", "window", "regions"), "{}")
        session |= {"id": f"{first:032x}", "status": "ended", "status_detail": "", "calibration_id": "c"}
        connection.execute(insert(tables.tables["sessions"]), session | {"is_simulated_beam": True, "created_at": at})
        frames = range(min(FRAMES_A_SESSION, samples - first))
        for begin in range(0, len(frames), PIECE):
            rows = [_sample(f"{first:032x}", index) for index in frames[begin : begin + PIECE]]
            connection.execute(insert(tables.tables["samples"]), rows)
            if first == begin == 0 and connection.dialect.name == "postgresql":
                connection.execute(text("ANALYZE samples"))  # the tests' server does not by itself


def _sample(session_id: str, index: int) -> dict[str, object]:
    times = dict.fromkeys(("received_ns", "decided_ns", "asserted_ns", "captured_ns"), index * 33_366_700)
    values = dict.fromkeys(("whole_mm", "thorax_mm", "abdomen_mm", "signal_mm"), index % 97 / 10.0)
    return {
        "session_id": session_id,
        "frame_index": index,
        "timestamp_us": index * 33_367,
        "missed_frames": 0,
        "state": "measuring",
        "gate": "beam_on",
        "line_on": True,
        "region_rows": 14,
        "regions_mm": bytes(14 * 8 * 4),
        **times,
        **values,
    }


def go_through(place: Path | URL, other: Path | URL, folder: Path, *, rows: int, samples: int) -> bool:
    """Make it, upgrade it, verify it, back it up, restore it, verify that; say whether both chains hold."""
    report = Report()
    typer.echo("| step | rows | s | rows/s | peak memory MB |\n|---|---|---|---|---|")
    (folder / "data").mkdir()
    (folder / "restored").mkdir()
    with closing(Database(place, answer_timeout_s=None)) as database:
        with report.timed(f"made at revision {OLD}", rows + samples):
            database.migrate(OLD)
            with database.write() as db:
                fill(db.connection(), rows, samples)
        with report.timed("upgraded to this version's", rows + samples):
            prepare(database, data_dir=folder / "data", min_free_disk_mb=0.0)
        is_intact = _verified(report, database, "audit chain verified")
        with report.timed("backed up", rows):
            make_backup(source_of(database, folder / "data"), folder / "all.backup", Silent())
    with closing(Database(other, answer_timeout_s=None)) as database, opened(folder / "all.backup") as backup:
        with report.timed("restored and compared", rows):
            target = Target(database=database, data_dir=folder / "restored", anchor_file=folder / "anchors.jsonl")
            restore(backup, target, actor="me", name="all.backup", progress=Silent())
        return _verified(report, database, "audit chain of the restored verified") and is_intact


def _verified(report: Report, database: Database, what: str) -> bool:
    with database.read() as db:
        began_rows = head_sequence(db)
        with report.timed(what, began_rows):
            found = audit.verify(db)
    typer.echo(f"chain: {found.detail}" if not found.is_intact else f"chain: intact, {found.rows:,} rows")
    return found.is_intact and found.rows == began_rows


def main() -> int:
    """Read the command line, and go."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.measurements.million_rows", description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--out", type=Path, help="folder to work in; a temporary one when left out")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.out) as folder:
        if given.database == "sqlite":
            places = Path(folder) / "made.db", Path(folder) / "restored.db"
            return 0 if go_through(*places, Path(folder), rows=given.rows, samples=given.samples) else 1
        server = PostgresServer()
        try:
            places = server.empty(), server.empty()
            return 0 if go_through(*places, Path(folder), rows=given.rows, samples=given.samples) else 1
        finally:
            server.close()


if __name__ == "__main__":
    sys.exit(main())
