"""Settings for a process or a test: variables of the environment, and a file for those that none overrides."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from service.core.settings.names import CONFIG, OVERRIDES, PREFIX, place_of
from service.core.settings.qa import KNOWN_BOUNDS
from service.core.settings.settings import Settings

FILE = "tidegate.toml"


def with_config(environment: Mapping[str, str], folder: Path) -> dict[str, str]:
    """Return the environment with settings that belong into the file moved to one in the folder.

    What is no setting at all stays, for the service to refuse.
    """
    kept = dict(environment)
    moved = {}
    for variable in environment:
        name = variable.removeprefix(PREFIX).lower()
        is_known = name in Settings.model_fields or name.removeprefix("qa_") in KNOWN_BOUNDS
        if variable.startswith(PREFIX) and is_known and name not in OVERRIDES:
            moved[name] = kept.pop(variable)
    if not moved:
        return kept
    path = folder / FILE
    tables = tomllib.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name, value in moved.items():
        section, key = place_of(name) if name in Settings.model_fields else ("qa", name.removeprefix("qa_"))
        tables.setdefault(section, {})[key] = value
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{section}.{key} = {json.dumps(value)}\n" for section, keys in tables.items() for key, value in keys.items()
    ]
    path.write_text("".join(lines), encoding="utf-8")
    return kept | {CONFIG: str(path)}


def give_settings(monkeypatch: pytest.MonkeyPatch, folder: Path, **values: object) -> None:
    """Set these for the test's own process."""
    environment = {f"{PREFIX}{name.upper()}": str(value) for name, value in values.items()}
    for name, value in with_config(environment, folder).items():
        monkeypatch.setenv(name, value)
