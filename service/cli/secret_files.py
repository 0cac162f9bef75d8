"""Keys and passwords that a command takes from a file or an environment variable, never from its arguments."""

import os
from pathlib import Path

from service.client import UsageError

KEY_VARIABLE = "TPS_KEY"
"""Holds the API key of a command that calls a service, unless a file is given."""


def secret_from(file: Path | None, variable: str) -> str:
    """Read a key or password from a file, else from an environment variable; raise UsageError where there is none."""
    found = file.read_text().strip() if file is not None else os.environ.get(variable, "")
    if not found:
        message = f"no key or password: give a file or set {variable}"
        raise UsageError(message)
    return found
