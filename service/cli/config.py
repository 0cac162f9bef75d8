"""``tidegate config``: what the site's settings are, and where each value comes from."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from service.cli.command_group import command_group
from service.cli.terminal import refused
from service.core.settings.config_file import ENVIRONMENT_ONLY, SettingsError
from service.core.settings.names import place_of, setting_name
from service.core.settings.qa import CHOSEN
from service.core.settings.settings import Settings, load_settings, sources
from service.storage.audit.check import redacted_settings

DEFAULT = "default"
WIDTH = 44

config = command_group("config", "Print every setting with its value, and where that comes from.")


@config.callback()
def _group() -> None:
    """Make it a group although it has one command."""


@config.command()
def show(
    changed: Annotated[bool, typer.Option("--changed", help="Only settings that are not at their default.")] = False,
    data: Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")] = None,
) -> None:
    """Print the settings as a file that TIDEGATE_CONFIG can name, with the source of each that is no default.

    Secrets are not printed. Exit code 2 where a setting cannot be used.
    """
    try:
        settings = load_settings(data_dir=data)
        came_from = sources(() if data is None else ("data_dir",))
    except SettingsError as error:
        raise refused("config show", error) from error
    typer.echo("\n".join(_lines(settings, came_from, changed=changed)))


def _lines(settings: Settings, came_from: dict[str, str], *, changed: bool) -> Iterator[str]:
    values = redacted_settings(settings)
    shown = [name for name in values if not (changed and came_from[name] == DEFAULT)]
    sections = dict.fromkeys(sorted(place_of(name)[0] for name in shown))
    for number, section in enumerate(sections):
        yield f"{chr(10) if number else ''}[{section}]"
        for name in sorted(one for one in shown if place_of(one)[0] == section):
            bounds = settings.qa_bounds_chosen if name == CHOSEN else {}
            yield from (f"{f'{key} = {bound:g}':<{WIDTH}}  # {came_from[name]}" for key, bound in bounds.items())
            if name != CHOSEN:
                yield _line(name, values[name], came_from[name])


def _line(name: str, value: object, source: str) -> str:
    key = place_of(name)[1]
    if name in ENVIRONMENT_ONLY:
        return f"# {setting_name(name)} is {value} ({source})"
    if value is None:
        return f"# {key} is not set"
    line = f"{key} = {json.dumps(value, ensure_ascii=False)}"
    return f"# {line}" if source == DEFAULT else f"{line:<{WIDTH}}  # {source}"
