"""A service on a fake engine, as tests/service has it, and plans sent to it."""

from typing import Any

import pytest

from tests.plans.made import photon_plan, written
from tests.service.conftest import calibration_id, calibration_text, client, engine, settings
from tests.service.people import PeopleClient

__all__ = ["calibration_id", "calibration_text", "client", "engine", "settings"]

URL = "/api/v1/plans"
DICOM = {"Content-Type": "application/dicom"}
BREATH_HOLD = {"kind": "breath_hold", "lower_mm": 8.0, "upper_mm": 12.0}
AMPLITUDE = {"lower_mm": -1.0, "upper_mm": 3.0}


def send(client: PeopleClient, content: bytes, **headers: str) -> Any:
    return client.post(URL, content=content, headers={**DICOM, **headers})


def kept(client: PeopleClient, **changes: Any) -> dict[str, Any]:
    """Import a photon plan with these changes."""
    answer = send(client, written(photon_plan(**changes)))
    assert answer.status_code == 201, answer.text
    return answer.json()


@pytest.fixture
def plan(client: PeopleClient) -> dict[str, Any]:
    return kept(client)


@pytest.fixture
def asked(calibration_id: str) -> dict[str, Any]:
    """What is asked for beside the plan."""
    return {
        "fraction_number": 3,
        "source": {"kind": "recording", "path": "chest.oni"},
        "calibration_id": calibration_id,
        "window": dict(BREATH_HOLD),
    }


def prepare(client: PeopleClient, plan: dict[str, Any], asked: dict[str, Any], **headers: str) -> Any:
    return client.post(f"{URL}/{plan['id']}/sessions", json=asked, headers=headers)
