"""Asked to end, the service holds the beam at once, closes the session, and has gone within five seconds."""

import contextlib
import json
import logging
import signal
import sqlite3
import threading
import time
from pathlib import Path

import pytest
from fastapi import FastAPI

from service.storage.samples.store import SampleStore
from service.web.server import make_server
from service.web.shutdown import Shutdown
from tests.support.service.api_calls import act, make_session_body, upload
from tests.support.service.processes import free_port, service_process
from tests.support.service.shutdown_cases import LONGEST_STOP_S, Case, end
from tests.support.waiting import eventually

pytestmark = pytest.mark.waiting

WORKER_THREADS = 40
"""As many as answer requests at once."""
BEYOND_HURRY = 9_500
"""More samples than are made Parquet on the way out."""


def said(ending):
    return [json.loads(line) for line in ending.log.splitlines() if line.startswith("{")]


def test_with_two_hundred_clients_and_everything_under_way_it_ends_in_its_time_and_loses_nothing(tmp_path):
    case = Case(
        name="a crowd",
        sockets=190,
        deaf_sockets=10,
        rows=BEYOND_HURRY,
        hang_s=1.0,
        is_busy=True,
        has_events=True,
    )
    found = end(case, tmp_path)
    assert (found.code, found.ended_s < LONGEST_STOP_S) == (0, True), found
    assert found.rows[-2:] == ("session.close", "service.stop")
    assert "gate.transition" in found.rows[-4:-2]
    assert found.status == "failed"  # an engine that did not answer is no ordinary end
    assert list((tmp_path / "data").glob("tidegate.db-*")) == [], "the database was not closed"
    batches = SampleStore(tmp_path / "data" / "samples").batches(_session_id(tmp_path / "data"))
    indices = [index for batch in batches for index in batch["frame_index"].to_pylist()]
    assert indices == list(range(len(indices)))
    assert len(indices) > BEYOND_HURRY
    assert "P-0001" not in found.log
    assert not any(line["level"] == "critical" for line in said(found))


def _session_id(data):
    with contextlib.closing(sqlite3.connect(data / "tidegate.db")) as raw:
        return raw.execute("SELECT id FROM sessions").fetchone()[0]


def test_a_person_who_presses_again_and_again_does_not_get_ahead_of_the_hold(tmp_path):
    found = end(Case(name="pressed again", hang_s=1.5, signals=4), tmp_path)
    assert found.held_s >= 1.5
    assert found.ended_s > found.held_s
    assert (found.code, found.status) == (0, "failed")
    assert "session.close" in found.rows


def test_a_qa_run_under_way_is_cancelled_and_the_process_ends_in_its_time(tmp_path):
    port, data = free_port(), tmp_path / "data"
    arguments = ("service.cli", "serve", "--port", str(port), "--data", str(data))
    with service_process(*arguments, port=port, log=tmp_path / "log", data=data) as (process, client):
        begun = client.post("/api/v1/qa/runs", json={"kind": "daily", "operator": "A. Physicist", "simulation": {}})
        assert begun.status_code == 202, begun.text
        process.send_signal(signal.SIGTERM)
        began_s = time.monotonic()
        assert process.wait(30.0) == 0
        assert time.monotonic() - began_s < LONGEST_STOP_S
    with contextlib.closing(sqlite3.connect(data / "tidegate.db")) as raw:
        assert list(raw.execute("SELECT status FROM qa_outcomes")) == [("cancelled",)]
        assert raw.execute("SELECT action FROM audit ORDER BY sequence DESC").fetchone() == ("service.stop",)


@pytest.fixture
def held():
    """When the beam was held."""
    return threading.Event()


def test_the_beam_is_held_although_the_event_loop_is_blocked(held):
    app = FastAPI()
    app.state.hold_and_close_session = held.set
    server = make_server(app, host="127.0.0.1", port=0)
    server._stop.watch()  # as it does when it runs; here nothing turns the loop at all
    server.handle_exit(signal.SIGTERM, None)
    assert held.wait(5.0)
    assert server.should_exit
    assert not server.force_exit
    server.handle_exit(signal.SIGTERM, None)
    assert server.force_exit


def test_the_beam_is_held_although_every_worker_thread_waits_for_something(held):
    let_go, waiting, closed = threading.Event(), [], threading.Event()

    @contextlib.asynccontextmanager
    async def lifespan(_app):
        yield
        closed.set()

    app = FastAPI(lifespan=lifespan)
    app.state.hold_and_close_session = held.set

    @app.get("/wait")
    def wait() -> None:
        waiting.append(1)
        let_go.wait(30.0)

    port = free_port()
    server = make_server(app, host="127.0.0.1", port=port)
    threading.Thread(target=lambda: _serve(server), daemon=True).start()
    eventually(lambda: server.started)
    asked = [threading.Thread(target=_ask, args=(port,), daemon=True) for _ in range(WORKER_THREADS + 5)]
    for one in asked:
        one.start()
    eventually(lambda: len(waiting) == WORKER_THREADS, within_s=20.0)
    server.should_exit = True
    try:
        assert held.wait(5.0)
        assert closed.wait(10.0), "the house waits for calls that hang"
    finally:
        let_go.set()
        for one in asked:
            one.join()


def _serve(server):
    import asyncio

    server._stop.watch()
    asyncio.run(server.serve())


def _ask(port):
    import http.client

    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=40.0)
    with contextlib.suppress(OSError, http.client.HTTPException):
        connection.request("GET", "/wait")
        connection.getresponse().read()
    connection.close()


class Left(list):
    """With what code the process would have been left."""

    def __call__(self, code):
        self.append(code)


def test_who_does_not_let_go_in_time_is_left_behind_once_the_session_is_closed(held, caplog):
    left = Left()
    stop = Shutdown(held.set, leave=left, within_s=0.2)
    stop.watch()
    stop.watch()  # once is enough
    stop.ask()
    with caplog.at_level(logging.ERROR, "service.web.shutdown"):
        eventually(lambda: left == [0])
    assert stop.is_closed
    assert "the session is closed" in caplog.text


def test_a_session_that_could_not_be_closed_is_stated_and_the_process_ends_with_another_code(caplog):
    left, go_on = Left(), threading.Event()
    stop = Shutdown(lambda: go_on.wait(20.0) and None, leave=left, within_s=0.2)
    stop.watch()
    stop.ask()
    with caplog.at_level(logging.ERROR, "service.web.shutdown"):
        eventually(lambda: left == [1])
    go_on.set()
    assert "NOT closed" in caplog.text


def test_a_failure_while_closing_does_not_block():
    left = Left()
    stop = Shutdown(lambda: 1 / 0, leave=left, within_s=0.2)
    stop.watch()
    stop.ask()
    stop.wait()
    eventually(lambda: left == [1])


def test_the_time_runs_from_the_first_signal():
    left, go_on = Left(), threading.Event()
    stop = Shutdown(lambda: go_on.wait(20.0) and None, leave=left, within_s=0.5)
    stop.watch()
    began_s = time.monotonic()
    stop.ask()
    while not left:
        stop.ask()  # repeated signals do not delay it
        assert time.monotonic() - began_s < 5.0
        go_on.wait(0.02)
    go_on.set()


def test_the_engine_s_own_process_ends_with_the_service(tmp_path, regular_volunteer):
    port, data = free_port(), tmp_path / "data"
    arguments = (
        "service.cli",
        "serve",
        "--port",
        str(port),
        "--data",
        str(data),
        "--recordings",
        str(regular_volunteer),
    )
    log = {"TIDEGATE_LOG_FORMAT": "json", "TIDEGATE_LOG_LEVEL": "info"}
    with service_process(*arguments, port=port, log=tmp_path / "log", data=data, environment=log) as (process, client):
        eventually(lambda: client.get("/readyz").json()["is_ready"], within_s=60.0)
        calibration = (regular_volunteer / "calibration.json").read_bytes()
        calibration_id = upload(client, calibration).json()["id"]
        body = make_session_body(calibration_id) | {"source": {"kind": "recording", "path": "recording.oni"}}
        session_id = client.post("/api/v1/sessions", json=body).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        eventually(lambda: "tidegate_fps" in client.get("/metrics").text, within_s=30.0)
        assert "tidegate_engine_process_resident_memory_bytes" in client.get("/metrics").text
        engines = children_of(process.pid)
        assert engines
        process.send_signal(signal.SIGTERM)
        began_s = time.monotonic()
        assert process.wait(30.0) == 0
        assert time.monotonic() - began_s < LONGEST_STOP_S
        eventually(lambda: not any(Path(f"/proc/{engine}").exists() for engine in engines))
    with contextlib.closing(sqlite3.connect(data / "tidegate.db")) as raw:
        rows = [row for (row,) in raw.execute("SELECT action FROM audit ORDER BY sequence")]
        assert raw.execute("SELECT status FROM sessions").fetchone() == ("stopped",)
    assert rows[-2:] == ["session.close", "service.stop"]
    lines = [line for line in (tmp_path / "log").read_text().splitlines() if line.startswith("{")]
    assert {json.loads(line).get("level") for line in lines} <= {"info", "warning"}


def children_of(process_id):
    """The processes that were begun by this one."""
    tasks = Path(f"/proc/{process_id}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]
