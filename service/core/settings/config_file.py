"""The site's file of settings (TOML), which ``TIDEGATE_CONFIG`` names: sections of keys, every name known."""

import difflib
import os
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from service.core.settings.names import CONFIG, place_of, setting_name
from service.core.settings.qa import CHOSEN, KNOWN_BOUNDS

MAX_BYTES = 1_000_000
ENVIRONMENT_ONLY = frozenset({"frame_path"})
"""Read by the engine when it is imported, before there are settings."""

CONSTANTS = frozenset(
    {
        "audit.anchor_interval_s",
        "audit.clock_jump_ms",
        "beam.notify_timeout_s",
        "match.min_explained_share",
        "match.seconds",
        "oidc.key_refresh_min",
        "oidc.max_key_age_h",
        "oidc.timeout_s",
        "plans.max_plan_bytes",
        "storage.sample_batch_ms",
        "training.components",
        "training.max_carry_mm",
        "training.min_amplitude_mm",
        "training.max_frames",
        "training.max_outlier_share",
        "training.max_shift_mm",
        "training.max_tilt_deg",
        "training.refit_until_s",
        "web.certificate_warn_days",
        "web.command_timeout_s",
        "web.idempotency_days",
        "web.live_resume_s",
        "web.live_stall_s",
        "web.max_body_bytes",
        "web.readiness_keep_ms",
    }
)
"""Settings of earlier versions that no site had to choose; each is a constant where it is used."""


class SettingsError(Exception):
    """The settings cannot be used; the message has one line per setting."""


def config_path() -> Path | None:
    """Return the file that the environment names; None without one."""
    named = os.environ.get(CONFIG)
    return Path(named) if named else None


def read_config(path: Path, known: Mapping[str, object]) -> dict[str, Any]:
    """Read the file: setting -> value, not yet checked against its bounds.

    Parameters
    ----------
    known
        The settings by name, with their types.

    Raises
    ------
    SettingsError
        The file cannot be read, is no TOML, or has a section or key that is none of Tidegate's; one line each.
    """
    names = {place_of(name): name for name in known if name not in ENVIRONMENT_ONLY | {CHOSEN}}
    names |= {("qa", key): CHOSEN for key in KNOWN_BOUNDS}
    found: dict[str, Any] = {}
    wrong: list[str] = []
    for section, keys in _tables(path).items():
        if not isinstance(keys, dict):
            wrong.append(f"{section} stands outside a section: {_where(section, names)}")
            continue
        for key, value in keys.items():
            name = names.get((section, key))
            if name is None:
                wrong.append(f"{section}.{key} is not a setting of Tidegate: {_where(key, names, section)}")
            elif isinstance(value, bool) and "bool" not in str(known[name]):
                wrong.append(f"{section}.{key} is {str(value).lower()}: must be no truth value")
            else:
                found[name] = found.get(name, {}) | {key: value} if name == CHOSEN else value
    if wrong:
        raise SettingsError("\n".join(f"{path}: {line}" for line in wrong))
    return found


def _tables(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            msg = f"{path} ({CONFIG}) has more than {MAX_BYTES} bytes"
            raise SettingsError(msg)
        return tomllib.loads(content.decode())
    except OSError as error:
        msg = f"{path} ({CONFIG}) cannot be read: {error.strerror or error}"
        raise SettingsError(msg) from error
    except ValueError as error:  # not UTF-8, or no TOML
        msg = f"{path} ({CONFIG}) is no TOML: {error}"
        raise SettingsError(msg) from error


def _where(key: str, names: Mapping[tuple[str, str], str], section: str = "") -> str:
    """Say what was perhaps meant."""
    if key in ENVIRONMENT_ONLY:
        return f"it is read from {setting_name(key)} only"
    if section == "http":
        return "limits of connections are no settings any more: remove the section"
    if f"{section}.{key}" in CONSTANTS:
        return "it is a constant now: remove the line"
    meant = {".".join(place) for place, name in names.items() if key in (place[1], name)}
    if not meant:
        every = [".".join(place) for place in names]
        meant = set(difflib.get_close_matches(f"{section}.{key}", every, n=2, cutoff=0.75))
    return f"perhaps {' or '.join(sorted(meant))}" if meant else "mistyped?"


def unknown_variables(names: Collection[str], known: Collection[str], allowed: Collection[str]) -> list[str]:
    """Return a line for each environment variable with Tidegate's prefix that is none of its own."""
    lines = []
    for variable in sorted(names):
        name = variable.upper().partition("_")[2].lower()
        if name in allowed or variable.upper() == CONFIG:
            continue
        if name in known or (bound := name.removeprefix("qa_")) in KNOWN_BOUNDS:
            place = ".".join(place_of(name)) if name in known else f"qa.{bound}"
            where = f"write {place} into the file that {CONFIG} names"
            lines.append(f"{variable} is not read from the environment: {where}")
        else:
            lines.append(f"{variable} is not a setting of Tidegate; mistyped?")
    return lines
