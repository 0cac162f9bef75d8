"""A provider on this machine, and the settings of a site that uses it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.core.settings.oidc import RETURN_PATH
from tests.support.oidc.provider_server import SECRET, Provider, running
from tests.support.oidc.site import GROUPS, SCOPES
from tests.support.oidc.tokens import AUDIENCE, CLIENT


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
