"""A real ``tidegate serve`` with a session on the long recording: of this checkout, or of an older one."""

import contextlib
import json
import os
import re
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx2

from service.core.permissions import Role
from service.core.settings.settings import Settings
from tests.support.repository import ROOT
from tests.support.service.accounts import provision
from tests.support.service.processes import free_port
from tests.support.site_settings import with_config

SCOPES = (
    *("sessions.read", "sessions.run", "gate.arm", "gate.hold", "calibrations.read", "calibrations.write"),
    *("metrics.read", "audit.read"),
)
OPERATOR = "Load"
START_S, LEARN_S, STOP_S = 60.0, 300.0, 60.0
LOOK_S, SOON_S = 0.1, 0.02
WINDOW = {"signal": "whole", "lower_mm": -3.0, "upper_mm": 2.0, "hysteresis_mm": 0.2, "dwell_ms": 200.0}
"""The beam goes on and off with every breath."""


class LoadError(Exception):
    """The run cannot go on; for the person who started it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """A service that runs, and how to speak to it; ``ready_s`` after its start it answered."""

    process: subprocess.Popen[bytes]
    port: int
    secret: str
    data: Path
    log: Path
    person_headers: dict[str, str]
    certificate: Path | None = None
    ready_s: float = 0.0

    @property
    def url(self) -> str:
        """Where it is reached: over TLS where it has a certificate."""
        return f"{'http' if self.certificate is None else 'https'}://127.0.0.1:{self.port}"

    @property
    def trusted(self) -> ssl.SSLContext | bool:
        """What a client verifies the service's certificate with."""
        return True if self.certificate is None else ssl.create_default_context(cafile=self.certificate)

    @property
    def authorization(self) -> str:
        """The header's value that a key is sent in."""
        return f"Bearer {self.secret}"

    def client(self, timeout_s: float = 60.0) -> httpx2.Client:
        """Open a client that speaks with the key."""
        headers = {"Authorization": self.authorization}
        return httpx2.Client(base_url=self.url, headers=headers, timeout=timeout_s, verify=self.trusted)

    def person(self) -> httpx2.Client:
        """Open a client of a logged-in person, who sets the reference."""
        return httpx2.Client(base_url=self.url, headers=self.person_headers, timeout=60.0, verify=self.trusted)

    def require_alive(self) -> None:
        """Raise with the log's end where it is dead."""
        if self.process.poll() is not None:
            raise LoadError(f"the service ended with {self.process.returncode}:\n{self.log.read_text()[-4000:]}")


@contextlib.contextmanager
def served(
    place: Path,
    recordings: Path,
    *,
    checkout: Path | None = None,
    environment: Mapping[str, str] | None = None,
    tls: tuple[Path, Path] | None = None,
) -> Iterator[Service]:
    """Run a service on a new data folder until the block ends; ``tls`` is its certificate and key."""
    root, port, data = (checkout or ROOT).resolve(), free_port(), place / "data"
    # A key arms here, and no person is at a page: presence is switched off, as a figure does not depend on it.
    given = {"TIDEGATE_MAX_LIVE_CLIENTS": "256", "TIDEGATE_OPERATOR_TIMEOUT_S": "0", **(environment or {})}
    if tls is not None:
        given |= {"TIDEGATE_TLS_CERT": str(tls[0]), "TIDEGATE_TLS_KEY": str(tls[1])}
    known = {**os.environ, "PYTHONPATH": str(root), **with_config(given, place / "config")}
    command = [sys.executable, "-m", "service.cli"]
    scopes = [part for scope in SCOPES for part in ("--scope", scope)]
    made = subprocess.run(
        [*command, "keys", "create", f"load-{port}", *scopes, "--days", "2", "--data", str(data)],
        cwd=root,
        env={**known, "COLUMNS": "400"},
        capture_output=True,
        text=True,
        check=False,
    )
    secret = re.search(r"tg_[\w-]{20,}", made.stdout + made.stderr)
    if made.returncode or secret is None:
        raise LoadError(f"no key could be made: {made.stdout}{made.stderr}")
    settings = _settings_for(data, given, tls)
    origin = f"{'http' if tls is None else 'https'}://127.0.0.1:{port}"
    let_in = provision(data, people={OPERATOR: {Role.THERAPIST}}, origin=origin, settings=settings)
    log, began_s = place / "serve.log", time.monotonic()
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*command, "serve", "--port", str(port), "--data", str(data), "--recordings", str(recordings)],
            cwd=root,
            env=known,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for the run, which closes the session and reads its samples first
        )
    service = Service(
        process=process,
        port=port,
        secret=secret[0],
        data=data,
        log=log,
        person_headers=let_in.headers,
        certificate=None if tls is None else tls[0],
    )
    try:
        _wait_until_it_answers(service)
        yield replace(service, ready_s=time.monotonic() - began_s)
    finally:
        if process.poll() is None:
            process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _settings_for(data: Path, given: Mapping[str, str], tls: tuple[Path, Path] | None) -> Settings:
    """Return what the log-in that is made beforehand depends on: the service's database, room and certificate."""
    certificate, key = tls or (None, None)
    url, room = given.get("TIDEGATE_DATABASE_URL"), given.get("TIDEGATE_ROOM", "")
    return Settings(data_dir=data, tls_cert=certificate, tls_key=key, database_url=url, room=room)


def learn(service: Service, folder: Path, recording: Path) -> dict[str, str]:
    """Learn a model in a session of its own; returns what a session of this patient then needs.

    How long that takes is the machine's business: where a busy one has not learned by the end of the recording, the
    recording is played again.
    """
    with service.client() as client:
        json_type = {"Content-Type": "application/json"}
        document = (folder / "calibration.json").read_bytes()
        calibration = _done(client.post("/api/v1/calibrations", content=document, headers=json_type))
        given = {"calibration_id": str(calibration["id"])}
        end_s = time.monotonic() + LEARN_S
        while True:
            session_id = _begin(client, recording, given)
            models = _models_of(service, client, session_id, end_s)
            stop_session(service, session_id)
            if models:
                return {**given, "model_id": str(models[0]["id"])}


def _begin(client: httpx2.Client, recording: Path, given: Mapping[str, str]) -> str:
    body = {
        "operator": "Load",
        "patient_reference": "P-0001",
        "plan_id": "PLAN-1",
        "fraction_id": "FX-1",
        "source": {"kind": "recording", "path": str(recording), "player": "reader"},
        "window": WINDOW,
        **given,
    }
    session_id = str(_done(client.post("/api/v1/sessions", json=body))["id"])
    _done(client.post(f"/api/v1/sessions/{session_id}/start", json={"operator": "Load"}))
    return session_id


def _models_of(service: Service, client: httpx2.Client, session_id: str, end_s: float) -> list[dict[str, Any]]:
    """Wait for a model of the session; none where its recording ends before."""
    while time.monotonic() < end_s:
        service.require_alive()
        is_running = _done(client.get(f"/api/v1/sessions/{session_id}"))["status"] == "running"
        models = _done(client.get(f"/api/v1/sessions/{session_id}/models"))["items"]
        if models or not is_running:
            return list(models)
        time.sleep(LOOK_S)
    raise LoadError(f"no model was learned within {LEARN_S:.0f} s")


def start_session(service: Service, recording: Path, given: Mapping[str, str]) -> str:
    """Begin a session with a model that was learned, set the reference, and arm; returns its id."""
    with service.client() as client:
        session_id = _begin(client, recording, given)
        while True:
            service.require_alive()
            detail = _done(client.get(f"/api/v1/sessions/{session_id}"))
            if detail["measurement_state"] == "measuring" and not detail["has_reference"]:
                with service.person() as person:
                    asked = {"operator": OPERATOR, "at": "now", "reason": "the load does not wait for breaths"}
                    person.post(f"/api/v1/sessions/{session_id}/reference", json=asked)
            answer = client.post(f"/api/v1/sessions/{session_id}/arm", json={"operator": "Load"})
            if answer.is_success:
                return session_id
            if answer.status_code != 409 or detail["status"] != "running":
                raise LoadError(f"the session cannot be armed: {answer.status_code} {answer.text}")
            time.sleep(LOOK_S)


def stop_session(service: Service, session_id: str) -> dict[str, Any]:
    """End a session and return what is known of it when all of it is written."""
    with service.client() as client:
        answer = client.post(f"/api/v1/sessions/{session_id}/stop", json={"operator": "Load"})
        if answer.status_code != 409:  # it may have ended by itself
            _done(answer)
        end_s = time.monotonic() + STOP_S
        while True:
            reported = _done(client.get(f"/api/v1/sessions/{session_id}"))
            if reported["status"] not in {"running", "created"} and reported.get("summary") is not None:
                return reported
            if time.monotonic() > end_s:
                raise LoadError(f"the session is not closed: {json.dumps(reported)[:500]}")
            time.sleep(LOOK_S)


def samples_of(service: Service, session_id: str) -> bytes:
    """Export a session's samples as an Arrow stream."""
    with service.client(600.0) as client:
        answer = client.get(f"/api/v1/sessions/{session_id}/samples", params={"format": "arrow"})
        answer.raise_for_status()
        return answer.content


def transitions_of(service: Service, session_id: str) -> int:
    """Count a session's transitions, page by page."""
    with service.client() as client:
        count, cursor = 0, None
        while True:
            parameters = {"limit": "200", **({"cursor": cursor} if cursor else {})}
            page = _done(client.get(f"/api/v1/sessions/{session_id}/transitions", params=parameters))
            count += len(page["items"])
            cursor = page.get("next_cursor")
            if cursor is None:
                return count


def _done(answer: httpx2.Response) -> dict[str, Any]:
    if not answer.is_success:
        raise LoadError(f"{answer.request.method} {answer.request.url.path}: {answer.status_code} {answer.text[:500]}")
    return answer.json()


def _wait_until_it_answers(service: Service) -> None:
    end_s = time.monotonic() + START_S
    with service.client() as client:
        while True:
            service.require_alive()
            with contextlib.suppress(httpx2.TransportError):
                if client.get("/healthz").status_code == 200:
                    return
            if time.monotonic() > end_s:
                raise LoadError(f"the service does not answer:\n{service.log.read_text()[-4000:]}")
            time.sleep(SOON_S)
