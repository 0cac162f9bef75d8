"""What a sample costs, in a table as before and in a stream.

Run: ``python -m tests.campaigns.measurements.sample_cost [--frames N]``.

Processor time of the writing thread a frame, and bytes a frame. The machine's speed cancels in the ratio.
"""

import argparse
import sqlite3
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from engine.control.outputs import FrameRecord
from service.storage.samples.legacy_rows import LISTS, PLAIN
from service.storage.samples.rows import sample_values
from service.storage.samples.store import SampleStore
from tests.support.samples.records import HEAD, SESSION, record

A_BATCH = 8
"""A quarter of a second at thirty frames."""


def made(frames: int) -> list[FrameRecord]:
    """Frames whose every cell moves: a constant would compress to nothing."""
    random = np.random.default_rng(1)
    return [_moved(record(index, whole_mm=float(random.normal())), random) for index in range(frames)]


def _moved(one: FrameRecord, random: np.random.Generator) -> FrameRecord:
    motion = one.measurement.motion
    assert motion is not None
    cells = random.normal(size=(14, 8)).round(4).astype(np.float32)
    return replace(one, measurement=replace(one.measurement, motion=replace(motion, regions_mm=cells)))


class OldTable:
    """The table that samples were inserted into until revision 0008, and how: a transaction a batch, fully synced."""

    def __init__(self, path: Path) -> None:
        from sqlalchemy import (
            Boolean,
            Column,
            Double,
            Integer,
            LargeBinary,
            MetaData,
            String,
            Table,
            create_engine,
            event,
        )

        kinds = {"state": String, "lost_reason": String, "gate": String, "hold_reason": String, "line_on": Boolean}
        whole = {name for name in PLAIN if name.endswith(("_ns", "_us", "frames", "index", "rows"))}
        columns = [Column(name, kinds.get(name, Integer if name in whole else Double)) for name in PLAIN]
        key = [Column("session_id", String, primary_key=True)]
        columns[0] = Column("frame_index", Integer, primary_key=True)
        blobs = [Column(name, LargeBinary) for name in LISTS]
        self.table = Table("samples", MetaData(), *key, *columns, *blobs, sqlite_with_rowid=False)
        self.engine = create_engine(f"sqlite:///{path}")

        @event.listens_for(self.engine, "connect")
        def _prepare(connection: sqlite3.Connection, _record: object) -> None:
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("PRAGMA synchronous=FULL")

        self.table.metadata.create_all(self.engine)

    def write(self, records: Sequence[FrameRecord]) -> None:
        """Insert a batch."""
        with self.engine.begin() as connection:
            connection.execute(self.table.insert(), [_row(one) for one in records])


def _row(one: FrameRecord) -> dict[str, object]:
    values = sample_values(one)
    blobs = {name: None if values[name] is None else np.asarray(values[name], "<f4").tobytes() for name in LISTS}
    return {"session_id": SESSION, **{name: values[name] for name in PLAIN}, **blobs}


def cost_us(write: Callable[[Sequence[FrameRecord]], object], frames: list[FrameRecord], label: str) -> float:
    """Processor time of this thread a frame [us]."""
    began_ns = time.thread_time_ns()
    for start in track(range(0, len(frames), A_BATCH), label, transient=True):
        write(frames[start : start + A_BATCH])
    return (time.thread_time_ns() - began_ns) / len(frames) / 1000


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=9000)
    frames = made(parser.parse_args().frames)
    console = Console(highlight=False, soft_wrap=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table = cost_us(OldTable(folder / "old.db").write, frames, "table")
        shelf = SampleStore(folder)
        began_s = time.perf_counter()
        stream = shelf.begin(HEAD)
        first_ms = (time.perf_counter() - began_s) * 1000

        def write(records: Sequence[FrameRecord]) -> None:
            stream.append(records)
            stream.sync()

        arrow = cost_us(write, frames, "stream")
        stream.finish()
        began_s = time.process_time()
        stored = shelf.settle(SESSION).stored
        settle_s = time.process_time() - began_s
        assert stored is not None
        console.print(f"frames                      {len(frames)}, {A_BATCH} a batch, each batch synced")
        console.print(f"table insert, as before     {table:.0f} us a frame")
        console.print(f"sealed stream               {arrow:.0f} us a frame, {arrow / table:.2f} of the insert")
        console.print(f"beginning a file            {first_ms:.1f} ms, before the session's engine is there")
        console.print(
            f"bytes a frame               {stream.path.stat().st_size / len(frames):.0f} in the stream, "
            f"{stored.size / len(frames):.0f} in Parquet"
        )
        hour_s = settle_s / len(frames) * 108_000
        console.print(f"closing                     {hour_s:.1f} s of processor time for an hour of frames, read back")


if __name__ == "__main__":
    main()
