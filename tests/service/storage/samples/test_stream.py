"""A session's stream: what is in it, what a kill leaves of it, and what somebody did to it."""

import errno
import os

import pyarrow as pa
import pytest

from service.storage.samples.layout import COLUMNS, SCHEMA_NAME, head_of
from service.storage.samples.store import SampleStore
from service.storage.samples.walk import Ending, NoSamplesError, StreamWalk
from tests.support.samples.records import HEAD, SESSION, frames_of, records, write_stream

pytestmark = pytest.mark.slow


def walked(path):
    with StreamWalk(path) as walk:
        rows = [row for batch in walk for row in batch.to_pylist()]
    return walk, rows


def places_of(path):
    """Where each batch ends, as the file says itself."""
    with StreamWalk(path) as walk:
        return [walk.end for _ in walk]


def test_a_file_describes_its_columns_to_readers_that_use_arrow_alone(tmp_path):
    path = write_stream(tmp_path).path
    with pa.OSFile(str(path)) as file, pa.ipc.open_stream(file) as reader:
        schema, table = reader.schema, reader.read_all()
    assert schema.metadata[b"tidegate.schema"].decode() == SCHEMA_NAME
    assert head_of(schema.metadata) == HEAD
    assert {field.name: field.metadata[b"unit"].decode() for field in schema}["volume_l"] == "l"
    assert all(field.metadata[b"meaning"] for field in schema)
    assert table.num_rows == 40
    assert [field.name for field in schema] == [column.name for column in COLUMNS]


def test_what_was_measured_is_what_is_read(tmp_path):
    walk, rows = walked(write_stream(tmp_path, 6).path)
    assert (walk.ending, walk.rows, walk.detail) == (Ending.CLOSED, 6, "")
    first, lost = rows[1], rows[4]
    assert (first["frame_index"], first["whole_mm"], first["state"]) == (1, 0.1, "measuring")
    assert (first["captured_ns"], first["received_ns"]) == (1_032_370_000, 1_033_370_000)
    assert (first["phase_percent"], first["rate_per_min"], first["region_rows"]) == (1.0, 14.0, 14)
    assert len(first["regions_mm"]) == 14 * 8
    assert first["regions_mm"][0] != first["regions_mm"][0], "the cell outside of the model is NaN"
    assert first["named_mm"] is None
    unknown = ("whole_mm", "volume_l", "regions_mm", "residual_mm", "phase_percent", "phase_confidence", "captured_ns")
    assert {name: lost[name] for name in unknown} == dict.fromkeys(unknown)
    assert (lost["state"], lost["lost_reason"], lost["gate"], lost["line_on"]) == ("lost", "marker_lost", "hold", False)


def test_a_file_that_is_cut_off_anywhere_gives_every_whole_batch_and_no_other(tmp_path):
    path = write_stream(tmp_path, is_finished=False).path
    content, places = path.read_bytes(), places_of(path)
    first = write_stream(tmp_path / "empty", 0, is_finished=False).path.stat().st_size
    for cut in range(first, len(content), 97):
        path.write_bytes(content[:cut])
        walk, rows = walked(path)
        assert len(rows) == 8 * sum(place <= cut for place in places)
        assert walk.ending is (Ending.OPEN if cut in {*places, first} else Ending.TORN)


def test_zeros_behind_the_last_batch_are_a_torn_tail_as_a_lost_power_leaves_it(tmp_path):
    path = write_stream(tmp_path, is_finished=False).path
    path.write_bytes(path.read_bytes() + bytes(3000))
    walk, rows = walked(path)
    assert (walk.ending, len(rows), path.stat().st_size - walk.end) == (Ending.TORN, 40, 3000)


def test_a_changed_byte_changes_nothing_that_is_read_or_is_found(tmp_path):
    path = write_stream(tmp_path, 24).path
    content = path.read_bytes()
    whole = walked(path)[1]
    found = 0
    for place in range(places_of(path)[0] - 2000, len(content) - 8, 61):
        changed = bytearray(content)
        changed[place] ^= 0x10
        path.write_bytes(changed)
        walk, rows = walked(path)
        if walk.ending is not Ending.CLOSED:
            assert repr(rows) == repr(whole[: len(rows)])
            found += 1
        else:
            assert repr(rows) == repr(whole), "only padding may be changed unseen"
    assert found > 50


@pytest.mark.parametrize(("batch", "ending"), [(2, Ending.DAMAGED), (4, Ending.TORN)])
def test_a_batch_that_cannot_be_read_is_damage_where_others_follow_it_and_a_torn_tail_where_none_does(
    tmp_path, batch, ending
):
    path = write_stream(tmp_path, is_finished=False).path
    content, places = bytearray(path.read_bytes()), places_of(path)
    content[places[batch - 1] + 4 : places[batch - 1] + 8] = (2**31 - 8).to_bytes(4, "little")
    path.write_bytes(content)
    walk, rows = walked(path)
    assert (walk.ending, len(rows)) == (ending, 8 * batch)


def test_a_batch_taken_out_is_found(tmp_path):
    path = write_stream(tmp_path).path
    content, places = path.read_bytes(), places_of(path)
    path.write_bytes(content[: places[0]] + content[places[1] :])
    walk, rows = walked(path)
    assert (walk.ending, len(rows)) == (Ending.DAMAGED, 8)
    assert "does not fit its seal" in walk.detail


def test_a_changed_head_is_found(tmp_path):
    path = write_stream(tmp_path).path
    path.write_bytes(path.read_bytes().replace(b"5" * 64, b"6" * 64, 1))
    assert walked(path)[0].ending is Ending.DAMAGED


def test_a_file_that_is_none_of_ours_is_refused(tmp_path):
    path = tmp_path / "other.arrows"
    for content in (b"", b"no arrow file", pa.ipc.serialize_pandas.__doc__.encode()):
        path.write_bytes(content)
        with pytest.raises(NoSamplesError):
            StreamWalk(path)


def test_a_running_session_s_samples_can_be_read_as_far_as_they_are_written(tmp_path):
    shelf = SampleStore(tmp_path)
    stream = shelf.begin(HEAD)
    assert frames_of(shelf) == []
    stream.append(records(8))
    assert frames_of(shelf) == [], "not on the disk yet"
    stream.sync()
    reading = shelf.batches(SESSION)
    stream.append(records(8, 8))
    stream.sync()
    assert frames_of(shelf) == list(range(16))
    assert sum(batch.num_rows for batch in reading) == 16
    stream.discard()
    assert not shelf.has(SESSION)


@pytest.mark.parametrize("taken", [0, 7, 3000])
def test_a_disk_that_takes_a_part_and_fails_leaves_no_batch_twice(tmp_path, monkeypatch, taken):
    shelf = SampleStore(tmp_path)
    stream = shelf.begin(HEAD)
    real = os.pwrite

    def fails(file, content, place):
        if taken and len(content) > taken:
            return real(file, content[:taken], place)
        raise OSError(errno.ENOSPC, "full")

    stream.append(records(8))
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", fails)
        with pytest.raises(OSError, match="full"):
            stream.sync()
    assert frames_of(shelf) == []
    stream.append(records(8, 8))
    stream.sync()
    stream.finish()
    assert frames_of(shelf) == list(range(16))
    assert walked(stream.path)[0].ending is Ending.CLOSED


def test_a_file_that_was_taken_away_or_replaced_is_noticed(tmp_path):
    stream = SampleStore(tmp_path).begin(HEAD)
    assert stream.is_there
    away = stream.path.rename(tmp_path / "away")
    assert not stream.is_there
    stream.path.write_bytes(away.read_bytes())
    assert not stream.is_there
    away.replace(stream.path)
    assert stream.is_there
    stream.release()


def test_every_batch_is_synced_before_it_counts_as_written(tmp_path, monkeypatch):
    stream = SampleStore(tmp_path).begin(HEAD)
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_size))
    for start in (0, 8):
        stream.append(records(8, start))
        stream.sync()
        assert synced[-1] == stream.path.stat().st_size
    stream.sync()
    assert len(synced) == 2, "nothing new, nothing to sync"
    stream.release()
