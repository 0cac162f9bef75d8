"""A service on fakes in which every call can succeed: a session that runs, a model, a QA run, people and keys.

Calls made up by a machine hardly ever name a thing that is there: the world tells one for each parameter and body, and
sees before a call that it is there.
"""

import base64
import contextlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from schemathesis.python import asgi

from engine.control.outputs import LiveView
from engine.core.breath import Breath
from engine.qa.results import QaKind
from service.access.accounts.passwords import PasswordService
from service.access.accounts.people import AccountService
from service.access.login.lockout import RefusedLogins
from service.access.login.logins import LoginService
from service.access.service import AccessService
from service.core.permissions import KEY_PERMISSIONS, Role
from service.core.settings.settings import Settings
from service.exchange.dicom import waveform
from service.sessions.views.live import NODE_COLUMNS, NODE_ROWS
from service.web.app import create_app
from service.web.dependencies import Services
from tests.support.exchange.session_curve import breathing_curve, subject
from tests.support.planning.dicom_plans import photon_plan, written
from tests.support.qa.fake_rig import FakeRig, qa_files
from tests.support.qa.sample_runs import BASELINE, report
from tests.support.service.accounts import EVERY_ROLE, PASSWORD, QuickHashing, headers_of, open_login
from tests.support.service.api_calls import make_calibration, make_session_body
from tests.support.service.fake_engine import FakeEngine, make_model
from tests.support.waiting import eventually

ADMIN, VIEWER, KEY, NOBODY = CALLERS = ("admin", "viewer", "key", "nobody")
ROLES = {ADMIN: EVERY_ROLE, VIEWER: frozenset({Role.VIEWER})}
V1 = "/api/v1"
PLAN_ROOT = "1.2.826.0.1.3680043.8.498"
ENDS_LOG_INS = frozenset(
    {"log_out", "change_password", "end_my_login", "end_user_login", "change_user", "revoke_key", "log_in"}
)
"""Made by somebody who is thrown away afterwards."""
OF_THE_CREATED = frozenset({"start_session", "sign_simulation", "read_simulation"})
NEEDS_NO_SESSION = OF_THE_CREATED | {"create_session", "start_qa_run", "fix_qa_baseline", "prepare_session"}
OF_THE_ENDED = {"add_note", "read_trace", "read_moment", "export_waveform", "send_session"}
"""Calls about a session that is over, beside those about a report."""


class World:
    """The service, and what there is in it."""

    def __init__(self, folder: Path) -> None:
        recordings = folder / "recordings"
        recordings.mkdir(parents=True)
        (recordings / "chest.oni").write_bytes(b"not read by the fake engine")
        qa_files(recordings)
        self.engine, self.rig = FakeEngine(), FakeRig()
        self.settings = Settings(
            data_dir=folder / "data",
            recordings_dirs=(recordings,),
            allowed_hosts=(asgi.HOST,),
            pacs="ARCHIVE@localhost:104",  # while a session runs, as here, nothing is sent
        )
        self.app = create_app(self.settings, lambda _settings: self.engine, lambda _settings: self.rig)
        self.client: Any = None
        self._numbers = itertools.count(1)
        self._bodies = self._ways()
        self._there_and_back = itertools.cycle((0.5, -0.5))
        self._people: dict[str, dict[str, str]] = {}
        self.key: dict[str, str] = {}
        self.known: dict[str, str] = {}

    @contextlib.contextmanager
    def open(self) -> Iterator["World"]:
        """Start the service and fill it."""
        with asgi.get_client(self.app) as client:
            self.client = client
            self._hash_quickly()
            self._fill()
            try:
                yield self
            finally:
                self.rig.go_on.set()
                asgi.shutdown_lifespans()

    @property
    def desk(self) -> AccessService:
        return self.app.state.access

    @property
    def _services(self) -> Services:
        return self.app.state.services

    def headers(self, caller: str, operation: str = "") -> dict[str, str]:
        """Return what a caller sends; for what ends a log-in, that of somebody no one misses."""
        if caller == NOBODY:
            return {"Origin": f"http://{asgi.HOST}"}
        if caller == KEY:
            return dict(self.key)
        if operation in ENDS_LOG_INS:
            name = f"Passer-by {next(self._numbers)}"
            return headers_of(open_login(self.desk.store, name, ROLES[caller]))
        if caller not in self._people:
            self._people[caller] = headers_of(open_login(self.desk.store, caller.title(), ROLES[caller]))
        return dict(self._people[caller])

    def send(self, method: str, path: str, body: object = None, **headers: str) -> Any:
        """Call as the administrator."""
        sent = {**self.headers(ADMIN), "Content-Type": "application/json", **headers}
        data = body if isinstance(body, bytes | str) else None if body is None else json.dumps(body)
        return self.client.request(method, f"http://{asgi.HOST}{path}", data=data, headers=sent)

    def ready(self, operation: str) -> None:
        """See that what a call needs is there."""
        if operation in NEEDS_NO_SESSION | NEEDS_A_SESSION or "session" in operation:
            self._end_qa_run()
        if operation in NEEDS_NO_SESSION:
            self._end_session()
        if operation in OF_THE_CREATED:
            self.known["session_id"] = self._create_session()
            if operation == "read_simulation":
                self._post(f"{V1}/sessions/{self.known['session_id']}/simulation", self._simulation_body())
        elif operation in {"start_qa_run", "cancel_qa_run"}:
            self._end_session()
            self._end_qa_run()
            if operation == "cancel_qa_run":
                self.known["run_id"] = self._begin_qa_run()
        elif operation not in NEEDS_NO_SESSION and ("session" in operation or operation in NEEDS_A_SESSION):
            self._run_session()
        if operation == "release_beam":
            self._post(f"{V1}/sessions/{self.known['session_id']}/hold")
        if operation in {"revoke_key", "read_key"}:
            self.known["key_id"] = self._make_key()["id"]
        if operation == "end_screen":
            screens = self.desk.screens
            self.known["screen_id"] = screens.pair(screens.open_code(by="tests").code, "127.0.0.1").screen.id
        if operation in {"change_user", "list_user_logins", "end_user_login", "read_user"}:
            self.known["name"] = f"Somebody {next(self._numbers)}"
            opened = open_login(self.desk.store, self.known["name"], {Role.VIEWER})
            self.known["login_id"] = opened.login.id

    def parameters(self, operation: str, headers: Mapping[str, str]) -> dict[str, str]:
        """Return values of path parameters that are there."""
        if operation == "end_my_login":
            return {"login_id": self._login_of(headers)}
        if operation in {"read_qa_run", "read_qa_report"}:
            return {"run_id": self.known["finished_run_id"]}
        if "report" in operation or operation in OF_THE_ENDED:
            return {"session_id": self.known["ended_session_id"]}
        return self.known

    def body(self, operation: str, body: object) -> object:
        """Return a body that can be, as near to a made-up one as that may be."""
        given = dict(body) if isinstance(body, dict) else {}
        if operation in self._bodies:
            return self._bodies[operation](given)
        return {name: value for name, value in given.items() if name != "operator"}

    def _ways(self) -> dict[str, Callable[[dict[str, Any]], object]]:
        """Return how the body of each call is made that needs more than its schema says."""
        return {
            "create_session": lambda given: self._session_body() | _of(given, "fraction_number", "plan_id"),
            "acknowledge_fault": lambda _: {},
            "sign_position": lambda _: {"reference_number": 1},
            "countersign": lambda _: {"state": "5e" * 16},
            "add_note": lambda _: self._note_body(),
            "sign_report": lambda _: self._note_body() | {"meaning": "checked", "password": PASSWORD},
            "send_session": lambda _: {"content_sha256": self._note_body()["content_sha256"]},
            "sign_simulation": lambda _: self._simulation_body(),
            "start_qa_run": lambda _: self._qa_body(),
            "fix_qa_baseline": lambda _: {"reason": "mounted anew", "expected": {"camera_distance_mm": 850.0}},
            "upload_calibration": lambda _: json.loads(make_calibration(f"camera {next(self._numbers)}").to_json()),
            "add_user": lambda given: {"roles": ["viewer"], **given, "name": f"New {next(self._numbers)}"},
            "create_key": lambda _: {**self._key_body(), "expires_at": _in_days(3)},
            "log_in": lambda _: self._log_in_body(),
            "change_password": lambda _: {"old_password": PASSWORD, "new_password": "another password for the tests"},
            "set_window": lambda _: {"window": self._session_body()["window"]},
            "correct_baseline": lambda _: {"by_mm": next(self._there_and_back), "drift_mm": 0.5},
            "import_plan": lambda _: written(photon_plan(SOPInstanceUID=f"{PLAN_ROOT}.{next(self._numbers)}")),
            "prepare_session": lambda _: self._planned_body(),
            "change_user": lambda _: {"is_break_glass": True},
            "pair_screen": lambda _: {"code": self.desk.screens.open_code(by="tests").code},
            "set_coaching": lambda _: {"display": "curve", "rest_s": 10.0, "sounds": True, "language": "de"},
        }

    # -- what is there ----------------------------------------------------------------------------------------------

    def _hash_quickly(self) -> None:
        desk = self.desk
        hashing = QuickHashing()
        logins = LoginService(
            desk.store, hashing, RefusedLogins(), lasts=timedelta(hours=12), idle=timedelta(minutes=30)
        )
        self.app.state.access = replace(
            desk,
            logins=logins,
            accounts=AccountService(desk.store, hashing.hash),
            passwords=PasswordService(pause_s=0.0),
        )
        desk.passwords.close()

    def _fill(self) -> None:
        made = self.desk.keys.create("campaign", KEY_PERMISSIONS, datetime.now(UTC) + timedelta(days=1), by="tests")
        self.key = {"Authorization": f"Bearer {made.secret}"}
        answer = self.send("POST", f"{V1}/calibrations", make_calibration().to_json())
        self.known["calibration_id"] = answer.json()["id"]
        self._run_session()
        self.engine.running.model = make_model(1)
        models = f"{V1}/sessions/{self.known['session_id']}/models"
        eventually(lambda: len(self.send("GET", models).json()["items"]) == 1)
        self.known["model_id"] = self.send("GET", models).json()["items"][0]["id"]
        for _ in range(3):
            self.engine.running.frame()
        self._end_session()
        self.known["ended_session_id"] = self.known["session_id"]
        plan = self.send("POST", f"{V1}/plans", written(photon_plan()), **{"Content-Type": "application/dicom"})
        self.known["plan_id"] = plan.json()["id"]
        self.known["finished_run_id"] = self._begin_qa_run()
        self._end_qa_run()
        self._run_session()

    def _run_session(self) -> None:
        """See that one runs, has frames, and obeys; the model is the one that runs, so that it can be activated."""
        session_id = self.known.get("session_id")
        if session_id is None or self._status(session_id) != "running":
            self._end_session()
            session_id = self.known["session_id"] = self._create_session()
            answer = self._post(f"{V1}/sessions/{session_id}/start")
            assert answer.status_code == 200, answer.text
            self.engine.running.model = make_model(1)
            models = f"{V1}/sessions/{session_id}/models"
            eventually(lambda: len(self.send("GET", models).json()["items"]) == 1)
            self.known["model_id"] = self.send("GET", models).json()["items"][0]["id"]
        running = self.engine.running
        running.breaths = (Breath(drift=0.5),)
        running.frame()
        running.latest = _with_surface(running.latest)

    def _create_session(self) -> str:
        answers: list[Any] = []

        def is_created() -> bool:  # the previous owner of camera and line may still be closing
            answers.append(self.send("POST", f"{V1}/sessions", self._session_body()))
            return bool(answers[-1].status_code == 201)

        eventually(is_created, detail=lambda: answers[-1].text)
        return str(answers[-1].json()["id"])

    def _end_session(self) -> None:
        for session in self._services.sessions.page(None, 5).items:
            if session.status in {"created", "running"}:
                self._services.runner.stop(session.id, "tests")

    def _status(self, session_id: str) -> str:
        return str(self._services.sessions.detail(session_id).status)

    def _begin_qa_run(self) -> str:
        self.rig.go_on.clear()
        self.rig.report = report(QaKind.DAILY, baseline=BASELINE)
        answers: list[Any] = []

        def is_begun() -> bool:  # the previous owner of camera and line may still be closing
            answers.append(self.send("POST", f"{V1}/qa/runs", self._qa_body()))
            return bool(answers[-1].status_code == 202)

        eventually(is_begun)
        return str(answers[-1].json()["id"])

    def _end_qa_run(self) -> None:
        self.rig.go_on.set()
        eventually(lambda: not self._is_qa_under_way())

    def _is_qa_under_way(self) -> bool:
        items = self._services.qa_archive.page(None, 1).items
        return bool(items) and items[0].status == "running"

    def _session_body(self) -> dict[str, Any]:
        body = make_session_body(self.known["calibration_id"])
        return {name: value for name, value in body.items() if name != "operator"}

    def _planned_body(self) -> dict[str, Any]:
        """A fraction of its own plan each: one that was begun is not begun again."""
        window = {"kind": "breath_hold", "lower_mm": 8.0, "upper_mm": 12.0}
        body = {name: value for name, value in self._session_body().items() if name in {"source", "calibration_id"}}
        return {**body, "window": window, "fraction_number": 1}

    def _qa_body(self) -> dict[str, Any]:
        return {
            "kind": "daily",
            "calibration_id": self.known["calibration_id"],
            "plate": {"source": {"kind": "recording", "path": "plate.oni"}},
        }

    def _note_body(self) -> dict[str, Any]:
        report = self._services.reports.of(self.known["ended_session_id"]).report
        return {"note": "calm breathing", "content_sha256": report.content_sha256}

    def _simulation_body(self) -> dict[str, Any]:
        patient = self._session_body()["patient_reference"]
        raw = waveform(subject(patient_id=patient), breathing_curve())
        return {"file": base64.b64encode(raw).decode(), "password": PASSWORD}

    def _log_in_body(self) -> dict[str, Any]:
        open_login(self.desk.store, "Somebody who logs in", {Role.VIEWER})
        return {"name": "Somebody who logs in", "password": PASSWORD}

    def _key_body(self) -> dict[str, Any]:
        return {"name": f"key {next(self._numbers)}", "scopes": ["sessions.read"]}

    def _make_key(self) -> dict[str, Any]:
        answer = self.send("POST", f"{V1}/keys", {**self._key_body(), "expires_at": _in_days(3)})
        assert answer.status_code == 201, answer.text
        return dict(answer.json())

    def _post(self, path: str, body: object = None) -> Any:
        return self.send("POST", path, body or {})

    def _login_of(self, headers: Mapping[str, str]) -> str:
        answer = self.client.get(f"http://{asgi.HOST}{V1}/me/logins", headers=dict(headers))
        items = answer.json().get("items", [])
        return str(items[0]["id"]) if items else "0" * 32


def _in_days(days: int) -> str:
    return (datetime.now(UTC) + timedelta(days=days)).isoformat()


def _of(given: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: given[name] for name in names if name in given}


def _with_surface(view: LiveView) -> LiveView:
    """Return a frame whose surface was measured, as a mesh needs it."""
    measurement = view.record.measurement
    motion = replace(measurement.motion, surface_mm=np.zeros((NODE_ROWS * NODE_COLUMNS, 3)))
    return replace(view, record=replace(view.record, measurement=replace(measurement, motion=motion)))


NEEDS_A_SESSION = frozenset(
    {
        *("set_reference", "sign_position", "countersign", "acknowledge_fault", "hold_beam"),
        *("release_beam", "note_presence", "correct_baseline", "set_window", "read_arming"),
        *("export_samples", "read_picture", "read_mesh", "retrain_model", "apply_model"),
        *("activate_model", "list_transitions", "read_coaching", "set_coaching"),
    }
)
