"""A service on a fake engine, with a calibration and a recording to make sessions from."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engine.calibration import Calibration
from engine.geometry import Intrinsics, RigidTransform
from service.app import create_app
from service.settings import Settings
from tests.service.fakes import FakeEngine, FakeRunning
from tests.service.people import PeopleClient

OPERATOR = {"operator": "A. Therapist"}
WINDOW = {"signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0, "hysteresis_mm": 0.2, "dwell_ms": 200.0}


def make_calibration(camera: str = "test") -> Calibration:
    intrinsics = Intrinsics(width=640, height=480, fx=570.0, fy=570.0, cx=319.5, cy=239.5)
    pose = RigidTransform(rotation=np.eye(3), translation_mm=np.array([25.0, 0.0, 0.0]))
    return Calibration(camera=camera, depth=intrinsics, color=intrinsics, color_from_depth=pose)


def eventually(condition: Callable[[], bool], *, within_s: float = 5.0) -> None:
    """Wait for another thread's work; fails instead of waiting for ever."""
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, "that did not happen in time"
        time.sleep(0.005)


@pytest.fixture
def settings(tmp_path: Path, database_url: str | None) -> Settings:
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    (recordings / "chest.oni").write_bytes(b"not read by the fake engine")
    return Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(recordings,),
        allowed_hosts=("testserver",),
        command_timeout_s=0.2,
        sample_batch_ms=20.0,
        database_url=database_url,
    )


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine()


@pytest.fixture
def client(settings: Settings, engine: FakeEngine, migrated_file: Path) -> Iterator[PeopleClient]:
    with PeopleClient(create_app(with_tables(settings, migrated_file), lambda _settings: engine)) as client:
        yield client


@pytest.fixture
def calibration_text() -> str:
    return make_calibration().to_json()


@pytest.fixture
def calibration_id(client: PeopleClient, calibration_text: str) -> str:
    return upload(client, calibration_text).json()["id"]


@pytest.fixture
def session_body(calibration_id: str) -> dict[str, Any]:
    return make_session_body(calibration_id)


@pytest.fixture
def session_id(client: PeopleClient, session_body: dict[str, Any]) -> str:
    return client.post("/api/v1/sessions", json=session_body).json()["id"]


@pytest.fixture
def running(client: PeopleClient, session_id: str, engine: FakeEngine) -> FakeRunning:
    assert act(client, session_id, "start").status_code == 200
    return engine.running


def with_tables(settings: Settings, migrated_file: Path) -> Settings:
    """Let a service find the newest tables; on PostgreSQL they are there anyway. Others try a first start."""
    if settings.database_url is None:
        settings.data_dir.mkdir(mode=0o700, exist_ok=True)
        shutil.copy(migrated_file, settings.database_place)
    return settings


def make_session_body(calibration_id: str) -> dict[str, Any]:
    return {
        "patient_reference": "P-0001",
        "plan_id": "PLAN-1",
        "fraction_id": "FX-3",
        "fraction_number": 3,
        **OPERATOR,
        "source": {"kind": "recording", "path": "chest.oni", "player": "auto"},
        "calibration_id": calibration_id,
        "window": dict(WINDOW),
    }


def upload(client: PeopleClient, text: str | bytes, **headers: str):
    return client.post(
        "/api/v1/calibrations",
        params={"operator": "A. Physicist"},
        content=text,
        headers={"Content-Type": "application/json", **headers},
    )


def act(client: PeopleClient, session_id: str, action: str, operator: str = "A. Therapist"):
    return client.post(f"/api/v1/sessions/{session_id}/{action}", json={"operator": operator})


def audit_rows(client: PeopleClient, action: str | None = None) -> list[dict[str, Any]]:
    """All audit rows, oldest first."""
    rows, cursor = [], None
    while True:
        page = client.get("/api/v1/audit", params={"limit": 500, **({"cursor": cursor} if cursor else {})}).json()
        rows += page["items"]
        cursor = page["next_cursor"]
        if cursor is None:
            return [row for row in reversed(rows) if action is None or row["action"] == action]


def edited(text: str, path: str, value: object) -> str:
    """Change one value of a JSON document; ``path`` is dotted."""
    document = json.loads(text)
    *parents, last = path.split(".")
    place = document
    for parent in parents:
        place = place[parent]
    place[last] = value
    return json.dumps(document)
