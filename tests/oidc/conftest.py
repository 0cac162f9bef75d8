"""A provider on this machine, and the settings of a site that uses it."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from service.oidc_settings import RETURN_PATH
from tests.oidc.provider_server import SECRET, Provider, running
from tests.oidc.tokens import AUDIENCE, CLIENT

GROUPS = "radiotherapy=therapist,physics=physicist,it=admin,physics=viewer"
SCOPES = "tidegate.read=sessions.read,tidegate.run=sessions.run"


@pytest.fixture
def outside():
    with running() as provider:
        yield provider


@pytest.fixture
def secret_file(tmp_path: Path) -> Path:
    path = tmp_path / "client-secret"
    path.write_text(f"{SECRET}\n")
    return path


@pytest.fixture
def oidc(secret_file: Path) -> Callable[..., dict[str, Any]]:
    """What a site sets, for a provider."""

    def settings(provider: Provider, **changes: Any) -> dict[str, Any]:
        given = {
            "oidc_issuer": provider.issuer,
            "oidc_client_id": CLIENT,
            "oidc_client_secret_file": secret_file,
            "oidc_redirect_uri": f"http://localhost{RETURN_PATH}",
            "oidc_group_roles": GROUPS,
            "oidc_machine_audience": AUDIENCE,
            "oidc_machine_scopes": SCOPES,
            **changes,
        }
        return {name: value for name, value in given.items() if value is not ...}

    return settings


def utc_now() -> datetime:
    return datetime.now(UTC)
