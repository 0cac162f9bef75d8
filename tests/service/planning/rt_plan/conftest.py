"""A service on a fake engine, as tests/service has it, and plans sent to it."""

from typing import Any

import pytest

from engine.core.signals import HeadDirection
from service.core.settings.settings import Settings
from tests.support.planning.api_calls import BREATH_HOLD, kept
from tests.support.service.accounts import PeopleClient


@pytest.fixture
def settings(settings: Settings) -> Settings:
    """A room whose gantry is at the top of the picture."""
    return settings.model_copy(update={"gantry_side": HeadDirection.TOP})


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
