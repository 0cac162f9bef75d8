"""No call turns the beam on: every route, called by a key with all scopes and by every role, against a recording line.

The engine, its loop and QA's drills are the real ones; the camera delivers no frame, so that nothing but a call could
be the reason of a permit. The one exception is QA: a physicist with a code from the machine.
"""

import itertools
import json
import threading
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.capture.source import SourceDescription
from engine.core.clock import MonotonicClock
from engine.core.errors import FrameTimeoutError
from service.access.request.rules import RULES, SOCKET
from service.core.permissions import KEY_PERMISSIONS, Role
from service.core.settings.settings import Settings
from service.engine_host.local_engine import LocalEngine
from service.qa.one_time_code import OneTimeCodes
from service.storage.database import queries
from service.web.app import create_app
from tests.support.contract.document import contract_app
from tests.support.database.migrated import with_tables
from tests.support.qa.fake_rig import qa_files
from tests.support.repository import ROOT
from tests.support.service.accounts import PASSWORD, PeopleClient, headers_of, open_login
from tests.support.service.api_calls import HEAD, make_calibration, make_session_body, upload
from tests.support.waiting import eventually

pytestmark = pytest.mark.verification

V1 = "/api/v1"
QA_RUNS = ("POST", f"{V1}/qa/runs")
MACHINE = "a key with every scope"
CALLERS = (MACHINE, *Role, "every role")
STATES = ("no session", "created", "running")
NOT_CALLED = {"/live", "/live/events", "/coach/live"}
"""Streams: they never end, and take no command (`service.web.stream`)."""
REQUESTS = json.loads((ROOT / "tests/support/contract/requests.json").read_text(encoding="utf-8"))
OPERATION_OF = {
    (method.upper(), path): operation["operationId"]
    for path, item in contract_app().openapi()["paths"].items()
    for method, operation in item.items()
}
DAILY = {"kind": "daily", "plate": {"source": {"kind": "recording", "path": "plate.oni"}}, "is_beam_safe": True}
TRIED_CODE = "2222-2222"


class RecordingLine(SimulatedBeamLine):
    """Notes every permit that it is given."""

    permits: list[int]

    def __init__(self, permits):
        super().__init__(MonotonicClock())
        self.permits = permits

    def permit(self, lease):
        self.permits.append(lease.sequence)
        super().permit(lease)


class SilentSource:
    """A camera that is open and delivers nothing."""

    def open(self):
        size = (640, 480)
        return SourceDescription(kind="test", name="silent", depth_size=size, color_size=size, fps=30.0, is_live=True)

    def read(self, timeout_s):
        threading.Event().wait(min(timeout_s, 0.05))
        raise FrameTimeoutError("no frame")

    def close(self):
        """Nothing is open."""


class SilentEngine(LocalEngine):
    """The engine with a camera that delivers nothing."""

    def _player(self, _path, _player):
        return SilentSource()


@pytest.fixture
def permits(monkeypatch) -> list[int]:
    """The permits of every beam line that the service builds, for sessions and for QA."""
    found: list[int] = []
    monkeypatch.setattr("service.engine_host.local_engine.make_beam_line", lambda *_: RecordingLine(found))
    monkeypatch.setattr("service.qa.rig.beam_line_parts", lambda *_: (RecordingLine(found),))
    return found


@pytest.fixture
def settings(tmp_path) -> Settings:
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    (recordings / "chest.oni").write_bytes(b"not read")
    qa_files(recordings)
    return Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(recordings,),
        allowed_hosts=("testserver",),
        recordings_may_gate=True,
        beam_line="modbus-tcp",
        beam_modbus_host="127.0.0.1",
    )


@pytest.fixture
def client(settings, permits, migrated_file):
    with PeopleClient(create_app(with_tables(settings, migrated_file), SilentEngine)) as client:
        client.speaks_as = None
        yield client


class World:
    """The service's state, and requests that are valid in it."""

    def __init__(self, client: PeopleClient) -> None:
        self.client = client
        self._numbers = itertools.count(1)
        self.owner = headers_of(open_login(client.desk.store, "A. Physicist"))
        answer = upload(client, make_calibration().to_json(), **self.owner)
        self.calibration_id = answer.json()["id"]
        self.session_id = "0" * 32

    def headers(self, who: str) -> dict[str, str]:
        """A caller of its own for each call: some calls end the log-in that makes them."""
        number = next(self._numbers)
        if who == MACHINE:
            until = datetime.now(UTC) + timedelta(days=1)
            made = self.client.desk.keys.create(f"key {number}", KEY_PERMISSIONS, until, by="test")
            return {"Authorization": f"Bearer {made.secret}"}
        roles = Role if who == "every role" else [Role(who)]
        return headers_of(open_login(self.client.desk.store, f"{who} {number}", roles))

    def bring_to(self, state: str) -> None:
        """Open or end sessions until the service is in a state."""
        services = self.client.app.state.services
        for session in services.sessions.page(None, 5).items:
            if session.status in queries.OPEN_STATUSES and (session.status != state):
                services.runner.stop(session.id, "test")
        is_there = any(one.status == state for one in services.sessions.page(None, 5).items)
        if state == "no session" or is_there:
            return
        body = make_session_body(self.calibration_id)
        body.pop("operator")
        answer = self.client.post(f"{V1}/sessions", json=body, headers=self.owner)
        assert answer.status_code == 201, answer.text
        self.session_id = answer.json()["id"]
        if state == "running":
            answer = self.client.post(f"{V1}/sessions/{self.session_id}/start", json={}, headers=self.owner)
            assert answer.status_code == 200, answer.text

    def call(self, method: str, path: str, headers: dict[str, str], **body: Any):
        """Make a call with a body that the contract takes, filled with what there is here."""
        for name in ("session_id", "calibration_id"):
            path = path.replace(f"{{{name}}}", getattr(self, name))
        path = path.replace("{name}", "A. Physicist").replace("{key_id}", "0" * 12)
        path = "/".join("0" * 32 if part.startswith("{") else part for part in path.split("/"))
        return self.client.request(
            method, path, headers=headers, json=None if method == "GET" else body, follow_redirects=False
        )

    def body(self, call: tuple[str, str]) -> dict[str, Any]:
        """Return a body that the call accepts."""
        if call == QA_RUNS:
            return DAILY | {"calibration_id": self.calibration_id, "code": TRIED_CODE}
        example = REQUESTS.get(OPERATION_OF[call], {})
        known = {"calibration_id": self.calibration_id, "password": PASSWORD}
        confirmed = HEAD if call[1].endswith("/arm") else {}
        return {**example, **{name: value for name, value in known.items() if name in example}, **confirmed}


@pytest.fixture
def world(client) -> World:
    return World(client)


def calls(state: str) -> list[tuple[str, str]]:
    """Every call of the table; what only reads in one state alone."""
    every = [call for call in RULES if call[0] != SOCKET and call[1].removeprefix(V1) not in NOT_CALLED]
    return [call for call in every if call in OPERATION_OF and (state == "running" or call[0] != "GET")]


@pytest.mark.parametrize("who", CALLERS)
@pytest.mark.parametrize("state", STATES)
def test_no_call_of_anybody_leads_to_a_permit(world, permits, who, state):
    answers = {}
    for call in calls(state):
        world.bring_to(state)
        answer = world.call(*call, world.headers(who), **world.body(call))
        answers[call] = answer.status_code
        assert permits == [], f"{call} by {who}: {answer.status_code}"
    assert answers[QA_RUNS] in {403, 409}
    refused = {call for call, status in answers.items() if status in {401, 403}}
    assert refused != answers.keys(), "the caller may do something"


@pytest.mark.parametrize("who", CALLERS)
def test_qa_permits_the_line_for_a_physicist_with_a_code_from_the_machine_alone(world, settings, permits, who):
    headers = world.headers(who)
    answer = world.client.get(f"{V1}/me", headers=headers)
    name = answer.json()["name"]
    body = world.body(QA_RUNS)
    given = OneTimeCodes(settings.data_dir).make(name)
    assert world.call(*QA_RUNS, headers, **body).status_code == 403
    assert permits == []
    answer = world.call(*QA_RUNS, headers, **body | {"code": given, "beam": {"repeats": 5}})
    if who not in {Role.PHYSICIST, "every role"}:
        assert (answer.status_code, answer.json()["code"]) == (403, "permission_missing")
        assert permits == []
        return
    assert answer.status_code == 202, answer.text
    eventually(lambda: permits, within_s=60.0)
