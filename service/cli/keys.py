"""``tidegate keys``: API keys for machines, on a data folder that no service uses."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer

from service.access.permissions import Permission
from service.cli.people import BY, DataOption, desks_of, say, table_of

keys = typer.Typer(
    name="keys",
    help="API keys for machines, on a data folder that no service uses.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
Data = Annotated[Path | None, DataOption]
ScopeOption = Annotated[
    list[Permission], typer.Option("--scope", help="What it may do; repeatable.", show_default=False)
]
DaysOption = Annotated[int, typer.Option(help="How long it lasts.", min=1, max=1825)]


@keys.command("list")
def list_keys(data: Data = None) -> None:
    """List the keys, newest first; their secrets are not kept."""
    now = datetime.now(UTC)
    with desks_of(data, "keys") as desks:
        rows = [
            [
                key.id,
                key.name,
                ",".join(sorted(key.scopes)),
                "revoked" if key.revoked_at else "over" if key.expires_at <= now else "",
                f"{key.expires_at:%Y-%m-%d}",
            ]
            for key in desks.keys.all()
        ]
    table_of(["id", "name", "scopes", "state", "until"], rows)


@keys.command()
def create(
    name: Annotated[str, typer.Argument(help="How the audit names it.", show_default=False)],
    scope: ScopeOption,
    days: DaysOption = 90,
    data: Data = None,
) -> None:
    """Make a key and print its secret, once."""
    with desks_of(data, "keys") as desks:
        made = desks.keys.create(name, scope, datetime.now(UTC) + timedelta(days=days), by=BY)
    say(f"{made.key.id}  {made.key.name}: {', '.join(sorted(made.key.scopes))}")
    say(f"Send it as `Authorization: Bearer ...`; it is told never again: {made.secret}")


@keys.command()
def revoke(key_id: Annotated[str, typer.Argument(help="As listed.", show_default=False)], data: Data = None) -> None:
    """Take a key back, for good."""
    with desks_of(data, "keys") as desks:
        key = desks.keys.revoke(key_id, by=BY)
    say(f"{key.id}  {key.name} is revoked.")
