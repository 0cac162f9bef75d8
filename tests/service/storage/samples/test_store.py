"""From stream to Parquet: whole or not at all, and whatever a kill leaves, one truth that can be read."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from service.storage.samples import parquet
from service.storage.samples.layout import head_of
from service.storage.samples.parquet import ROWS_A_GROUP, NotReadBackError
from service.storage.samples.store import SampleStore
from service.storage.samples.walk import Ending, StreamWalk
from tests.support.samples.records import HEAD, SESSION, frames_of, records, write_stream


@pytest.fixture
def shelf(tmp_path):
    return SampleStore(tmp_path)


def rows_of(shelf):
    return [row for batch in shelf.batches(SESSION) for row in batch.to_pylist()]


def test_parquet_states_what_the_stream_stated(shelf):
    write_stream(shelf.folder)
    before = repr(rows_of(shelf))
    settled = shelf.settle(SESSION)
    assert shelf.has(SESSION)
    shelf.forget_stream(SESSION)
    assert repr(rows_of(shelf)) == before
    assert (settled.stored.rows, settled.is_whole, settled.ending) == (40, True, Ending.CLOSED)
    table = pq.read_table(shelf.parquet_path(SESSION), use_threads=False)
    assert head_of(table.schema.metadata) == HEAD
    assert {column.compression for column in columns_of(shelf)} == {"ZSTD"}


def columns_of(shelf):
    group = pq.ParquetFile(shelf.parquet_path(SESSION)).metadata.row_group(0)
    return [group.column(index) for index in range(group.num_columns)]


@pytest.mark.parametrize(("rows", "groups"), [(50, [20, 20, 10]), (24, [20, 4]), (40, [20, 20])])
def test_a_long_session_comes_in_groups_of_five_minutes(shelf, monkeypatch, rows, groups):
    monkeypatch.setattr(parquet, "ROWS_A_GROUP", 20)
    write_stream(shelf.folder, rows)
    shelf.settle(SESSION)
    found = pq.ParquetFile(shelf.parquet_path(SESSION)).metadata
    assert [found.row_group(index).num_rows for index in range(found.num_row_groups)] == groups
    assert frames_of(shelf) == list(range(rows))
    assert ROWS_A_GROUP == 5 * 60 * 30


def test_a_session_without_a_frame_has_a_file_without_a_row(shelf):
    write_stream(shelf.folder, 0)
    assert shelf.settle(SESSION).stored.rows == 0
    shelf.forget_stream(SESSION)
    assert shelf.has(SESSION)
    assert frames_of(shelf) == []


def test_a_file_that_is_not_read_back_as_it_was_written_is_none(shelf, monkeypatch):
    write_stream(shelf.folder)
    monkeypatch.setattr(parquet, "_group_digests", lambda _path: iter(["another"]))
    with pytest.raises(NotReadBackError):
        shelf.settle(SESSION)
    assert [path.name for path in shelf.folder.iterdir()] == [f"{SESSION}.arrows"]
    assert frames_of(shelf) == list(range(40))


def test_a_file_with_fewer_rows_than_the_stream_is_none(shelf, monkeypatch):
    write_stream(shelf.folder)
    real = parquet._groups
    monkeypatch.setattr(parquet, "_groups", lambda schema, batches: (one.slice(1) for one in real(schema, batches)))
    with pytest.raises(NotReadBackError, match="40 rows, and 39"):
        shelf.settle(SESSION)


def test_what_arrow_itself_cannot_write_is_the_disk_s_error(shelf, monkeypatch):
    write_stream(shelf.folder)

    def fails(*_arguments):
        raise pa.ArrowInvalid("no")

    monkeypatch.setattr(parquet, "_write", fails)
    with pytest.raises(OSError, match="could not be written"):
        shelf.settle(SESSION)
    assert frames_of(shelf) == list(range(40))


@pytest.mark.parametrize("step", ["write", "check", "name", "forget"])
def test_a_kill_at_any_step_of_a_closing_leaves_it_to_be_done_again(shelf, monkeypatch, step):
    """Killed: nothing is cleaned up, so the partial file stays as it was."""
    write_stream(shelf.folder)
    if step == "write":
        shelf.parquet_path(SESSION).with_suffix(".parquet.partial").write_bytes(b"PAR1 half a file")
    elif step == "check":
        shelf.settle(SESSION)
        shelf.parquet_path(SESSION).rename(shelf.parquet_path(SESSION).with_suffix(".parquet.partial"))
    elif step == "name":
        shelf.parquet_path(SESSION).write_bytes(b"of an earlier try")
    else:
        shelf.settle(SESSION)
    shelf.sweep()
    assert shelf.left_streams() == [SESSION]
    assert frames_of(shelf) == list(range(40)), "the stream is the truth, whatever lies beside it"
    assert shelf.settle(SESSION).stored.rows == 40
    shelf.forget_stream(SESSION)
    assert [path.name for path in shelf.folder.iterdir()] == [f"{SESSION}.parquet"]
    assert frames_of(shelf) == list(range(40))


def test_a_torn_tail_is_cut_off_and_stated(shelf):
    path = write_stream(shelf.folder, is_finished=False).path
    path.write_bytes(path.read_bytes()[:-100])
    settled = shelf.settle(SESSION)
    assert (settled.stored.rows, settled.ending, settled.kept_aside) == (32, Ending.TORN, None)
    assert settled.lost_bytes > 100
    assert not settled.is_whole
    assert settled.audit_detail["lost_bytes"] == settled.lost_bytes


def test_a_session_that_was_killed_between_two_batches_lost_nothing(shelf):
    write_stream(shelf.folder, is_finished=False)
    settled = shelf.settle(SESSION)
    assert (settled.is_whole, settled.ending, settled.stored.rows) == (True, Ending.OPEN, 40)


def test_a_damaged_stream_is_kept_aside_whole(shelf):
    path = write_stream(shelf.folder).path
    content = bytearray(path.read_bytes())
    with StreamWalk(path) as walk:
        ends = [walk.end for _ in walk]
    content[(ends[1] + ends[2]) // 2 + 400] ^= 1
    path.write_bytes(content)
    settled = shelf.settle(SESSION)
    shelf.forget_stream(SESSION)
    assert (settled.stored.rows, settled.ending) == (16, Ending.DAMAGED)
    assert (shelf.folder / settled.kept_aside).read_bytes() == bytes(content)
    assert frames_of(shelf) == list(range(16))
    assert (shelf.left_streams(), shelf.stored()) == ([], [SESSION])


def test_a_stream_whose_head_is_gone_is_kept_aside_and_makes_no_parquet(shelf):
    path = write_stream(shelf.folder).path
    path.write_bytes(b"\0" * 500)
    settled = shelf.settle(SESSION)
    shelf.forget_stream(SESSION)
    assert (settled.stored, settled.is_whole, settled.lost_bytes) == (None, False, 500)
    assert (shelf.folder / settled.kept_aside).stat().st_size == 500
    assert not shelf.has(SESSION)


def test_who_reads_while_the_stream_is_forgotten_reads_on(shelf):
    write_stream(shelf.folder)
    reading = shelf.batches(SESSION)
    shelf.settle(SESSION)
    shelf.forget_stream(SESSION)
    assert sum(batch.num_rows for batch in reading) == 40


def test_memory_stays_flat_however_long_a_session_is(shelf):
    """By count: settling holds one group of rows, reading one piece of it."""
    stream = shelf.begin(HEAD)
    for start in range(0, 3000, 500):
        stream.append(records(500, start))
        stream.sync()
        assert len(stream._memory.held) == 0
    stream.finish()
    before = pa.total_allocated_bytes()
    most = 0
    shelf.settle(SESSION)
    for batch in shelf.batches(SESSION):
        assert batch.num_rows <= parquet.READ_ROWS
        most = max(most, pa.total_allocated_bytes() - before)
    del batch
    assert most < 16_000_000
    assert pa.total_allocated_bytes() <= before + 100_000
