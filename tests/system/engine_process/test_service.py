"""Service and engine process killed, stopped and asked to stop, judged by the receiver and the audit."""

import os
import signal
import time

import pytest

from tests.support.beam.receivers import Lateness
from tests.support.engine_process.bench import MS, PATIENT, SILENCE_MS, WINDOW, Line, eventually, is_there, line_at
from tests.support.engine_process.process_ids import engine_pid, engine_pids
from tests.support.engine_process.real_time_program import LINE
from tests.support.engine_process.service_program import PIPE
from tests.support.service.api_calls import act, audit_rows, make_calibration, make_session_body, upload
from tests.support.service.processes import free_port, service_process

pytestmark = [pytest.mark.waiting, pytest.mark.long]

LEASE_NS = int(PATIENT["lease_ms"] * MS)
SILENCE_NS = int(SILENCE_MS * MS)
PACED = "real_time_program"


class Running:
    """A service with a session whose beam is on."""

    def __init__(self, process, client, line: Line) -> None:
        self.process, self.client, self.line = process, client, line
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        body = make_session_body(calibration_id) | {"window": WINDOW}
        self.session_id = client.post("/api/v1/sessions", json=body).json()["id"]
        assert act(client, self.session_id, "start").status_code == 200
        self.engine = engine_pid(process.pid, PACED)

    def detail(self):
        return self.client.get(f"/api/v1/sessions/{self.session_id}").json()

    def turn_on(self) -> None:
        eventually(self._is_on)

    def _is_on(self) -> bool:
        gate = self.detail()["gate"]
        if gate is not None and not gate["is_armed"]:
            if gate["state"] == "fault":
                act(self.client, self.session_id, "acknowledge")
            act(self.client, self.session_id, "arm")
        return self.line.is_on

    def transitions(self):
        return [row["detail"] for row in audit_rows(self.client, "gate.transition")]


@pytest.fixture(scope="module")
def lateness():
    with Lateness() as held:
        yield held


@pytest.fixture
def line(tmp_path):
    with line_at(tmp_path / "line") as held:
        yield held


@pytest.fixture
def started(tmp_path, line):
    """Start services on the same data, one after another."""
    (tmp_path / "chest.oni").write_bytes(b"")

    def start():
        port = free_port()
        arguments = ("tests.support.engine_process.service_program", str(tmp_path / "data"), str(port))
        log = tmp_path / f"log-{port}"
        return service_process(
            *arguments,
            port=port,
            log=log,
            data=tmp_path / "data",
            environment={LINE: str(line.path), PIPE: str(tmp_path / "pipe")},
        )

    return start


def test_a_service_that_is_killed_has_its_beam_held_at_once_and_its_last_transitions_found(started, line, lateness):
    with started() as (process, client):
        running = Running(process, client, line)
        running.turn_on()
        process.send_signal(signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        process.wait()
        edge, *times_ns = line.await_off()
        assert edge == "held", "by the engine's process, not by its lease"
        assert int(times_ns[0]) <= killed_ns + lateness.allowed_ns
        eventually(lambda: not is_there(running.engine))
    with started() as (_, client):
        assert client.get(f"/api/v1/sessions/{running.session_id}").json()["status"] == "interrupted"
        reported = [row["detail"] for row in audit_rows(client, "gate.transition")]
        assert "service_silent" in [one["reason"] for one in reported if one.get("recovered")]
        assert client.get("/api/v1/audit/verify").json()["is_intact"]


def test_an_engine_that_is_killed_closes_its_session_as_failed_and_another_begins(started, line, tmp_path):
    with started() as (process, client):
        running = Running(process, client, line)
        running.turn_on()
        os.kill(running.engine, signal.SIGKILL)
        eventually(lambda: running.detail()["status"] == "failed")
        assert "signal 9" in running.detail()["status_detail"]
        closed = audit_rows(client, "session.close")[-1]["detail"]
        assert "died" in closed["tape_torn"]
        states = [one["to_state"] for one in running.transitions()]
        assert states.count("beam_on") >= 1
        assert not list(tmp_path.rglob("*.journal")), "it was read, written down, and removed"
        (alarm,) = running.detail()["alarms"]
        assert (alarm["code"], alarm["priority"], alarm["acknowledged_by"]) == ("engine_failed", "high", None)
        again = Running(process, client, line)
        assert again.engine != running.engine
        again.turn_on()
        assert running.detail()["alarms"] == [], "the next session has begun"
        ended = [row["detail"]["code"] for row in audit_rows(client, "alarm.end")]
        assert "engine_failed" in ended
        assert act(client, again.session_id, "stop").json()["status"] == "stopped"
        eventually(lambda: not line.is_on)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
        assert engine_pids(process.pid) == []


def test_a_service_that_is_stopped_has_its_beam_held_and_goes_on_later(started, line, lateness):
    with started() as (process, client):
        running = Running(process, client, line)
        running.turn_on()
        process.send_signal(signal.SIGSTOP)
        stopped_ns = time.monotonic_ns()
        edge, *times_ns = line.await_off()
        process.send_signal(signal.SIGCONT)
        assert edge == "held"
        assert int(times_ns[0]) <= stopped_ns + SILENCE_NS + LEASE_NS + lateness.allowed_ns
        running.turn_on()
        assert "service_silent" in [one["reason"] for one in running.transitions()]


def test_a_service_whose_event_loop_is_blocked_has_its_beam_held_as_a_silent_one(started, line, lateness, tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with started() as (process, client):
        running = Running(process, client, line)
        running.turn_on()
        process.send_signal(signal.SIGUSR1)
        blocked_ns = time.monotonic_ns()
        edge, *times_ns = line.await_off()
        pipe.write_bytes(b"go on")
        assert edge == "held", "by the engine's process: every other thread of the service goes on"
        assert int(times_ns[0]) <= blocked_ns + SILENCE_NS + LEASE_NS + lateness.allowed_ns
        running.turn_on()
        assert "service_silent" in [one["reason"] for one in running.transitions()]


def test_a_stopped_engine_does_not_outlive_a_service_that_is_killed(started, line):
    with started() as (process, client):
        running = Running(process, client, line)
        running.turn_on()
        os.kill(running.engine, signal.SIGSTOP)
        line.await_off()
        process.send_signal(signal.SIGKILL)
        process.wait()
        eventually(lambda: not is_there(running.engine))


def test_on_a_stop_signal_only_the_service_decides_when_its_engine_ends(started, line):
    with started() as (process, client):
        running = Running(process, client, line)
        running.turn_on()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(running.engine, number)
        assert act(client, running.session_id, "hold").status_code == 200, "it lives, and obeys"
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
        assert not is_there(running.engine)
        assert line.edges[-1][0] != "on"
