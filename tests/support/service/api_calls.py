"""The calls that most tests of the service make: upload, start, arm, read the audit trail."""

import json
from typing import Any

import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.core.geometry import Intrinsics, RigidTransform
from tests.support.service.accounts import PeopleClient

OPERATOR = {"operator": "A. Therapist"}

HEAD = {"head_direction": "top"}

WINDOW = {"signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0, "hysteresis_mm": 0.2, "dwell_ms": 200.0}


def make_calibration(camera: str = "test") -> Calibration:
    intrinsics = Intrinsics(width=640, height=480, fx=570.0, fy=570.0, cx=319.5, cy=239.5)
    pose = RigidTransform(rotation=np.eye(3), translation_mm=np.array([25.0, 0.0, 0.0]))
    return Calibration(camera=camera, depth=intrinsics, color=intrinsics, color_from_depth=pose)


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
        **HEAD,
    }


def upload(client: PeopleClient, text: str | bytes, **headers: str):
    return client.post(
        "/api/v1/calibrations",
        params={"operator": "A. Physicist"},
        content=text,
        headers={"Content-Type": "application/json", **headers},
    )


PRESENT = {"at": "now", "reason": "as the test wants it"}
"""The present position becomes the reference, wherever in the breath it is: tests do not wait for two breaths."""


def act(client: PeopleClient, session_id: str, action: str, operator: str = "A. Therapist", **more: object):
    confirmed = {"arm": HEAD, "reference": PRESENT}.get(action, {})
    return client.post(f"/api/v1/sessions/{session_id}/{action}", json={"operator": operator, **confirmed, **more})


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
