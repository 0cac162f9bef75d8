"""Migration 0008: samples of older sessions leave the database for files and go back; nothing is lost either way."""

import json

import numpy as np
import pyarrow as pa
import pytest
from sqlalchemy import text

from service.storage.samples import legacy_rows
from service.storage.samples.layout import SampleHead
from service.storage.samples.store import SampleStore
from tests.support.database.rows import add_rows

pytestmark = pytest.mark.both_databases

ROWS = 25
CELLS = np.arange(112, dtype="<f4")
CELLS[3] = np.nan


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "samples"


@pytest.fixture
def old(database, folder):
    """A database of revision 0007 with a session of some frames, and what its rows said."""
    database.downgrade("0007", samples_dir=folder)
    with database.connect() as connection, connection.begin():
        add_rows(connection)
        connection.execute(text("DELETE FROM idempotency_keys"))
        session_id = connection.execute(text("SELECT id FROM sessions")).scalar_one()
        regions = json.dumps({"named": [{"name": "belly"}, {"name": "left"}]})
        connection.execute(text("UPDATE sessions SET regions = :regions"), {"regions": regions})
        for index in range(5, 5 + ROWS):
            connection.execute(legacy_rows.INSERT, row(session_id, index))
    return session_id


def row(session_id, index):
    is_lost = index % 5 == 4
    measured = None if is_lost else 0.1 * index
    reals = ("whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "signal_mm", "residual_mm", "valid_share")
    return {
        "session_id": session_id,
        "frame_index": index,
        "timestamp_us": index * 33_370,
        "missed_frames": 0,
        "state": "lost" if is_lost else "measuring",
        "lost_reason": "marker_lost" if is_lost else None,
        **dict.fromkeys(reals, measured),
        "gate": "hold",
        "hold_reason": "dwell",
        "line_on": index % 2 == 0,
        "received_ns": 2**40 + index,
        "decided_ns": 2**40 + index + 1,
        "asserted_ns": 2**40 + index + 2,
        "captured_ns": None if is_lost else 2**40 + index - 1,
        "phase_percent": measured,
        "region_rows": None if is_lost else 14,
        "regions_mm": None if is_lost else (CELLS + index).tobytes(),
        "named_mm": None if is_lost else (CELLS[:2] + index).tobytes(),
    }


def table_of(database):
    with database.connect() as connection:
        rows = connection.execute(text("SELECT * FROM samples ORDER BY session_id, frame_index")).mappings().all()
    return [
        {name: bytes(value) if name.endswith("s_mm") and value else value for name, value in row.items()}
        for row in rows
    ]


def test_up_and_down_every_value_is_as_it_was(database, folder, old, monkeypatch):
    monkeypatch.setattr(legacy_rows, "ROWS_A_PIECE", 7)
    before = table_of(database)
    assert len(before) == ROWS + 1
    database.migrate(samples_dir=folder)
    shelf = SampleStore(folder)
    read = [row for batch in shelf.batches(old) for row in batch.to_pylist()]
    assert [row["frame_index"] for row in read] == [1, *range(5, 5 + ROWS)]
    assert read[1]["whole_mm"] == pytest.approx(0.5)
    assert read[1]["regions_mm"][:3] == [5.0, 6.0, 7.0]
    assert shelf.head(old).regions == ("belly", "left")
    database.downgrade("0007", samples_dir=folder)
    assert repr(table_of(database)) == repr(before)


def test_a_file_that_a_downgrade_left_stays_when_it_knows_as_many_rows(database, folder, old):
    database.migrate(samples_dir=folder)
    path = SampleStore(folder).parquet_path(old)
    before = path.read_bytes()
    database.downgrade("0007", samples_dir=folder)
    assert path.exists(), "the table cannot hold all that the file says"
    database.migrate(samples_dir=folder)
    assert path.read_bytes() == before


def test_without_a_folder_nothing_moves_and_the_table_stays(database, folder, old):
    with pytest.raises(ValueError, match="no folder for them"):
        database.migrate()
    assert len(table_of(database)) == ROWS + 1


def test_a_disk_that_is_full_leaves_the_table_as_it_was(database, folder, old, monkeypatch):
    def full(*_arguments):
        raise OSError(28, "full")

    with monkeypatch.context() as patch:
        patch.setattr(legacy_rows, "write_parquet", full)
        with pytest.raises(OSError, match="full"):
            database.migrate(samples_dir=folder)
    assert len(table_of(database)) == ROWS + 1
    database.migrate(samples_dir=folder)
    assert SampleStore(folder).stored() == [old]


def test_the_memory_of_a_move_is_one_piece_whatever_the_session_s_length(database, folder, old, monkeypatch):
    """By count: no more rows are held than a piece and a group."""
    monkeypatch.setattr(legacy_rows, "ROWS_A_PIECE", 4)
    with database.connect() as connection:
        sizes = [piece.num_rows for piece in legacy_rows._pieces(connection, old, SampleHead(session_id=old).schema)]
    assert max(sizes) == 4
    assert sum(sizes) == ROWS + 1
    assert pa.total_allocated_bytes() < 50_000_000
