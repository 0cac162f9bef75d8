"""A service whose patience is short, with a session running in it whose gate goes on and off."""

import contextlib
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.processes import free_port, service_process
from tests.support.service.self_driving_program import LIMITS
from tests.support.waiting import eventually
from verification.attack.limits import PATIENCE_S, SECRET

FRAMES_A_SECOND = 10
"""Fewer than the fake camera's thirty: this is about harm, the figures are the load test's."""
SHORT = dict.fromkeys(("header_s", "body_s", "keep_alive_s", "write_s"), PATIENCE_S)


@dataclass(slots=True)
class Attacked:
    """The service, and what is known of its session."""

    port: int
    client: Any
    key: dict[str, str]
    session_id: str
    log: Path
    process: Any
    begun: tuple[float, int] = field(default=(0.0, 0))

    def frames(self) -> int:
        return sum(line.startswith("sample ") for line in self.log.read_text(errors="replace").splitlines())

    def watch(self) -> None:
        self.begun = time.monotonic(), self.frames()

    def assert_unharmed(self) -> None:
        """The session runs, its frames went on, the service answers, and the log tells nothing of the inside."""
        assert self.process.poll() is None, self.log.read_text(errors="replace")[-4000:]
        assert self.client.get("/healthz").status_code == 200
        assert self.client.get(f"/api/v1/sessions/{self.session_id}").json()["status"] == "running"
        begin_s, before = self.begun
        due = int((time.monotonic() - begin_s - 0.5) * FRAMES_A_SECOND)
        eventually(lambda: self.frames() > before, within_s=2.0)
        assert self.frames() - before >= due
        reported = self.log.read_text(errors="replace")
        assert "Traceback" not in reported, reported[-4000:]
        assert SECRET not in reported


@pytest.fixture(scope="package")
def served(tmp_path_factory) -> Iterator[Attacked]:
    folder = tmp_path_factory.mktemp("attack")
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 65_536), most))
    (folder / "chest.oni").write_bytes(b"")
    port, log = free_port(), folder / "log"
    arguments = ("tests.support.service.self_driving_program", str(folder / "data"), str(folder), str(port))
    environment = {LIMITS: json.dumps({**SHORT, "max_connections_per_address": 128})}
    with contextlib.ExitStack() as stack:
        started = service_process(*arguments, port=port, log=log, data=folder / "data", environment=environment)
        process, client = stack.enter_context(started)
        client.headers["Connection"] = "close"  # the service closes one that is kept, perhaps as the next call is sent
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        yield Attacked(port, client, client.key_headers, session_id, log, process)


@pytest.fixture
def attacked(served) -> Iterator[Attacked]:
    """The service before an attack; after it nothing may have come to harm."""
    served.watch()
    yield served
    served.assert_unharmed()
