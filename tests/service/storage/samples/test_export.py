"""Samples over the API: while a session runs, when it is closed, in every format; and none that are gone."""

import io

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from service.storage.samples.layout import head_of
from tests.support.service.api_calls import act, audit_rows
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow


def samples(client, session_id, form=None):
    return client.get(f"/api/v1/sessions/{session_id}/samples", params={} if form is None else {"format": form})


def csv_frames(answer):
    return [int(line.partition(",")[0]) for line in answer.text.splitlines()[1:]]


def test_a_running_session_s_samples_are_exported_as_far_as_they_are_written(client, session_id, running):
    assert csv_frames(samples(client, session_id)) == []
    for _ in range(10):
        running.frame()
    eventually(lambda: csv_frames(samples(client, session_id)) == list(range(10)))
    with pa.ipc.open_stream(samples(client, session_id, "arrow").content) as reader:
        assert reader.read_all()["frame_index"].to_pylist() == list(range(10))


def test_parquet_is_refused_until_the_session_is_closed(client, session_id, running):
    running.frame()
    answer = samples(client, session_id, "parquet")
    assert (answer.status_code, answer.json()["code"], answer.json()["field"]) == (409, "session_state", "format")
    act(client, session_id, "stop")
    answer = samples(client, session_id, "parquet")
    assert answer.headers["content-type"] == "application/vnd.apache.parquet"
    assert f'filename="{session_id}.parquet"' in answer.headers["content-disposition"]
    assert pq.read_table(io.BytesIO(answer.content), use_threads=False)["whole_mm"].to_pylist() == [1.5]


@pytest.mark.parametrize("is_closed", [False, True])
def test_arrow_states_with_what_it_was_measured_and_nothing_of_whom(client, session_id, running, is_closed):
    running.frame()
    eventually(running.samples.empty)
    if is_closed:
        act(client, session_id, "stop")
    content = samples(client, session_id, "arrow").content
    with pa.ipc.open_stream(content) as reader:
        head = head_of(reader.schema.metadata)
    assert head.session_id == session_id
    assert head.software.startswith("tidegate ")
    assert (len(head.settings_sha256), len(head.calibration_sha256), head.monotonic_ns > 0) == (64, 64, True)
    assert b"P-0001" not in content


def test_a_format_that_does_not_exist_is_refused(client, session_id):
    answer = samples(client, session_id, "xlsx")
    assert (answer.status_code, answer.json()["field"]) == (422, "format")


def test_samples_that_were_removed_are_stated_to_be(client, session_id, running, settings):
    running.frame()
    act(client, session_id, "stop")
    (settings.data_dir / "samples" / f"{session_id}.parquet").unlink()
    answer = samples(client, session_id)
    assert (answer.status_code, answer.json()["code"]) == (404, "samples_removed")


def test_the_close_row_reports_what_the_samples_are_known_by(client, session_id, running):
    for _ in range(5):
        running.frame()
    act(client, session_id, "stop")
    (row,) = audit_rows(client, "session.close")
    reported = row["detail"]["samples"]
    assert (reported["rows"], reported["ending"], reported["lost_bytes"]) == (5, "closed", 0)
    assert len(reported["parquet_sha256"]) == len(reported["stream_sha256"]) == 64
