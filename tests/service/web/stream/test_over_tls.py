"""The live stream and downloads where the service speaks TLS itself: asyncio buffers twice there."""

import json
from itertools import pairwise

import pyarrow as pa
import pytest

from service.web.connections.http_protocol import BoundedHttp
from tests.support.access.tls_certificate import make_certificate
from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.processes import free_port, service_process
from tests.support.stream.stream_server import Served, messages, next_of, read_until, served
from tests.support.stream.tls_socket import TlsSocket
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.waiting

SAMPLES = 45
MOST_UNSENT = 6
"""Messages of 20 kB on their way to a client that reads nothing: in the system's buffers, in asyncio's two, in the task
that sends."""
ROWS = 12_000
LARGER_THAN_BUFFERS = 6_000_000
"""Bytes: Linux keeps up to 4 MB of a download that is not read, asyncio 512 KiB above TLS and 64 KiB below."""


@pytest.fixture(scope="module")
def process(tmp_path_factory):
    """A service process with a certificate, its session under way; gives the client and the session's id."""
    folder = tmp_path_factory.mktemp("process")
    tls = make_certificate(folder)
    (folder / "chest.oni").write_bytes(b"")
    port, data = free_port(), folder / "data"
    arguments = ("tests.support.service.self_driving_program", str(data), str(folder), str(port))
    with service_process(*arguments, port=port, log=folder / "log", data=data, tls=tls) as (_, client):
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        yield client, session_id


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls")
    cert, key = make_certificate(folder)
    with served(folder, tls_cert=cert, tls_key=key) as one:
        yield one


@pytest.fixture
def session_id(service):
    """A session, begun once the clients of the test before have left the stream."""
    service.await_clients(0)
    session_id = service.begin_session()
    yield session_id
    service.end_session(session_id)


def check_stream(found, session_id):
    """Check consecutive messages: a hello, then every frame that the server saw, each once and in order."""
    kinds = [one["type"] for one in found]
    assert kinds[0] == "hello"
    assert set(kinds[1:]) <= {"sample", "dropped", "ping"}
    samples = [one for one in found if one["type"] == "sample"]
    assert len(samples) >= SAMPLES
    assert {one["session_id"] for one in samples} == {session_id}
    steps = [after["sequence"] - before["sequence"] for before, after in pairwise(samples)]
    assert min(steps) >= 1
    assert sum(steps) == len(steps) + sum(one["skipped"] for one in found if one["type"] == "dropped")


def taken(found):
    """Take messages until there are enough samples."""
    samples = 0
    for one in found:
        yield one
        samples += one["type"] == "sample"
        if samples == SAMPLES:
            return


def test_a_websocket_over_tls_gets_every_sample_of_a_running_session(process):
    client, session_id = process
    url = f"wss://127.0.0.1:{client.base_url.port}/api/v1/live"
    with TlsSocket(url, client.key_headers, client.trusted) as socket:
        check_stream(list(taken(messages(socket))), session_id)


def test_server_sent_events_over_tls_carry_every_sample_of_a_running_session(process):
    client, session_id = process
    with client.stream("GET", "/api/v1/live/events", headers=client.key_headers, timeout=PATIENCE_S) as answer:
        lines = (line.removeprefix("data: ") for line in answer.iter_lines() if line.startswith("data: "))
        check_stream(list(taken(json.loads(line) for line in lines)), session_id)


@pytest.mark.parametrize("path", ["/api/v1/live", "/api/v1/live/events"])
def test_hardly_anything_waits_for_a_client_over_tls_that_does_not_read(service: Served, session_id: str, path: str):
    service.make_messages_big()
    slow = service.raw(path)
    service.await_clients(1)
    service.frames(60)
    (client,) = service.hub._clients
    assert 60 - client.slot.skipped <= MOST_UNSENT
    slow.close()


def test_a_stalled_client_over_tls_goes_on_with_the_newest_and_hinders_no_other(service: Served, session_id: str):
    service.make_messages_big()
    before = service.hub.reading().closed.get("stalled", 0)
    with service.watch("?form=thin") as healthy:
        slow = service.raw("/api/v1/live")
        service.await_clients(2)
        for _ in range(40):
            service.frames(1)
            assert next_of(healthy, "sample")["frame_index"] == service.hub.newest.index
    raw = bytearray()
    found = read_until(slow, raw, service.hub.newest.index)
    samples = [one for one in found if one["type"] == "sample"]
    assert len(samples) <= MOST_UNSENT + 1
    assert len(samples) + sum(one["skipped"] for one in found if one["type"] == "dropped") == 40
    service.running.operator_hold = None
    for index in (40, 41):  # each once the one before was read: only the newest waits for a client
        service.frames(1)
        fresh = [one["frame_index"] for one in read_until(slow, raw, index) if one["type"] == "sample"]
    assert fresh[-2:] == [40, 41]
    assert service.hub.reading().closed.get("stalled", 0) == before
    slow.close()


def test_clients_over_tls_that_never_read_are_cut_off(tmp_path):
    cert, key = make_certificate(tmp_path)
    with served(tmp_path, tls_cert=cert, tls_key=key, stall_s=1.0) as service:
        session_id = service.begin_session()
        service.make_messages_big()
        stalled = [service.raw(path) for path in ("/api/v1/live", "/api/v1/live/events")]
        service.await_clients(2)
        service.frames(20)
        service.await_closed("stalled", 2)
        for one in stalled:
            one.close()
        service.end_session(session_id)


def test_an_export_over_tls_larger_than_every_buffer_waits_for_its_reader_and_comes_whole(
    service: Served, session_id: str
):
    for _ in range(ROWS):
        eventually(lambda: service.running.samples.qsize() < 600)
        service.running.frame()
    service.recorded(session_id, ROWS - 1)
    with (
        service.http() as client,
        client.stream("GET", f"/api/v1/sessions/{session_id}/samples?format=arrow") as answer,
    ):
        assert answer.status_code == 200
        eventually(lambda: any(_is_paused(one) for one in tuple(service.server.server_state.connections)))
        body = b"".join(answer.iter_bytes())
    assert len(body) > LARGER_THAN_BUFFERS
    rows = pa.ipc.open_stream(body).read_all()
    assert rows["frame_index"].to_pylist() == list(range(ROWS))


def _is_paused(connection: object) -> bool:
    """Whether the answer on this connection waits until its client reads."""
    return isinstance(connection, BoundedHttp) and connection.flow is not None and connection.flow.write_paused
