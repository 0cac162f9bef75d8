"""Calls of the plan API, with plans to send."""

from typing import Any

from tests.support.planning.dicom_plans import photon_plan, written
from tests.support.service.accounts import PeopleClient

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


def prepare(client: PeopleClient, plan: dict[str, Any], asked: dict[str, Any], **headers: str) -> Any:
    return client.post(f"{URL}/{plan['id']}/sessions", json=asked, headers=headers)
