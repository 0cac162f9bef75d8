"""A treatment room for tests: a real service on the virtual Xtion, a Modbus receiver of its own, and a person."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

from tests.support.beam import modbus_server
from tests.support.beam.receivers import TIMES, Receiver, receiver
from tests.support.service.api_calls import act, audit_rows, upload
from tests.support.service.processes import free_port, service_process
from tests.support.virtual_camera.camera import VirtualXtion
from tests.support.virtual_camera.film import Film

PATIENCE_S = 60.0
WIDE = {"signal": "whole", "lower_mm": -40.0, "upper_mm": 40.0, "hysteresis_mm": 0.2, "dwell_ms": 100.0}
SETTINGS = {
    "BEAM_LINE": "modbus-tcp",
    "BEAM_MODBUS_HOST": "127.0.0.1",
    "BEAM_MODBUS_UNIT": modbus_server.UNIT,
    "BEAM_MODBUS_PERMIT_COIL": modbus_server.COIL,
    "BEAM_MODBUS_HEARTBEAT_REGISTER": modbus_server.REGISTER,
    "BEAM_MODBUS_READBACK_INPUT": modbus_server.INPUT,
    "BEAM_ANSWER_MS": TIMES.answer_ms,
    "BEAM_SETTLE_MS": TIMES.settle_ms,
    "TRAINING_MIN_FRAMES": 60,
    "TRAINING_MIN_CYCLES": 1,
    "TRAINING_MIN_SECONDS": 5.0,
    "MIN_FREE_DISK_MB": 0,
    "MAX_DUTY_PERCENT": 100,
    "WARM_UP_MIN": 0,
}
"""Learns from little, for a test's sake; what the gate trusts is as it comes, but that the beam
may be on during the whole breath, and that no test waits a quarter of an hour for a camera that gets no warmer."""


class RoomError(AssertionError):
    """Something in the room did not come true in time."""


@dataclass(kw_only=True)
class Room:
    """See the module."""

    camera: VirtualXtion
    far: Receiver
    client: httpx2.Client
    calibration_id: str = ""
    model_id: str | None = None
    session_id: str = ""
    sessions: list[str] = field(default_factory=list)

    # -- looking ------------------------------------------------------------------------------------------------

    @property
    def detail(self) -> dict[str, Any]:
        return self.client.get(f"/api/v1/sessions/{self.session_id}").json()

    @property
    def gate(self) -> dict[str, Any]:
        return self.detail["gate"] or {"state": None, "is_armed": False, "reason": None}

    @property
    def is_on(self) -> bool:
        """Whether the beam is on, as its receiver says."""
        return bool(self.far.seen) and self.far.seen[-1][0] == "on"

    def offs(self, since_ns: int) -> list[int]:
        """When the receiver went off, from a time on."""
        return [int(edge[1]) for edge in list(self.far.seen) if edge[0] == "off" and int(edge[1]) >= since_ns]

    def ons(self, since_ns: int) -> list[int]:
        """When the receiver went on, from a time on."""
        return [int(edge[1]) for edge in list(self.far.seen) if edge[0] == "on" and int(edge[1]) >= since_ns]

    def reasons(self) -> list[str | None]:
        """Why the gate moved, in order, in this session."""
        rows = audit_rows(self.client, "gate.transition")
        return [row["detail"]["reason"] for row in rows if row["session_id"] == self.session_id]

    def until(self, condition: Callable[[], object], what: str, within_s: float = PATIENCE_S) -> None:
        """Wait for something; fails with what the session says instead of waiting for ever."""
        deadline_s = time.monotonic() + within_s
        while not condition():
            if time.monotonic() > deadline_s:
                msg = f"{what} did not come: {self.detail if self.session_id else ''}, {self.far.seen[-4:]}"
                raise RoomError(msg)
            time.sleep(0.01)

    # -- doing --------------------------------------------------------------------------------------------------

    def begin(self, **changes: object) -> str:
        """Make and start a session, with the model that was learned before where there is one."""
        body = {
            "patient_reference": "P-1",
            "plan_id": "PLAN",
            "fraction_id": "FX",
            "operator": "A. Therapist",
            "source": {"kind": "device", "uri": None},
            "calibration_id": self.calibration_id,
            "model_id": self.model_id,
            "head_direction": "top",
            "window": WIDE,
        } | changes
        answer = self.client.post("/api/v1/sessions", json=body)
        assert answer.status_code == 201, answer.text
        self.session_id = answer.json()["id"]
        self.sessions.append(self.session_id)
        answer = self.act("start")
        assert answer.status_code == 200, answer.text
        return self.session_id

    def act(self, action: str):
        return act(self.client, self.session_id, action)

    def turn_on(self) -> int:
        """Do what a person does until the receiver says on: acknowledge, set the zero, arm; returns when it went on."""
        self.until(lambda: self._one_step() or self.is_on, "the beam", within_s=2 * PATIENCE_S)
        return int(self.far.seen[-1][1])

    def _one_step(self) -> bool:
        detail = self.detail
        gate = detail["gate"]
        if self.is_on or gate is None:
            return self.is_on
        if gate["state"] == "fault":
            self.act("acknowledge")
        elif not gate["is_armed"] and detail["measurement_state"] == "measuring":
            _ = detail["has_reference"] or self.act("reference")
            self.act("arm")
        time.sleep(0.03)
        return self.is_on

    def stop(self) -> None:
        """End the session, if it runs."""
        if self.session_id:
            self.act("stop")
            self.until(lambda: self.detail["status"] not in {"running", "stopping"}, "the session's end")


@contextlib.contextmanager
def room(
    folder: Path,
    film: Film | None = None,
    *,
    seen_as: Callable[[VirtualXtion], dict[str, str]] = lambda camera: camera.environment,
    **settings: object,
) -> Iterator[Room]:
    """Open a room whose camera a person has calibrated; ``seen_as`` is the environment in which the camera is seen."""
    port = free_port()
    with VirtualXtion(folder, film) as camera, receiver("tcp") as far:
        with contextlib.suppress(OSError):  # a real receiver shares its processor with no one
            os.setpriority(os.PRIO_PROCESS, far.process.pid, -15)
        own = {name.upper(): value for name, value in settings.items()}
        reported = {**SETTINGS, "BEAM_MODBUS_PORT": far.where, "OPERATOR_TIMEOUT_S": 0.0, **own}
        environment = seen_as(camera) | {f"TIDEGATE_{name}": str(value) for name, value in reported.items()}
        arguments = ("service.cli", "serve", "--port", str(port), "--data", str(folder / "data"))
        started = service_process(
            *arguments, port=port, log=folder / "log", environment=environment, data=folder / "data"
        )
        with started as (_, client):
            held = Room(camera=camera, far=far, client=client)
            held.calibration_id = upload(client, camera.film.calibration_path.read_bytes()).json()["id"]
            yield held
