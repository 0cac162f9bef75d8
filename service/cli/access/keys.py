"""``tidegate keys``: API keys of machines, in a data folder that no service uses."""

from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer

from service.cli.access.account_services import BY, Data, account_services, print_table
from service.cli.command_group import command_group
from service.core.permissions import Permission

keys = command_group("keys", "Manage the API keys of machines, while no service uses the data folder.")
ScopeOption = Annotated[
    list[Permission], typer.Option("--scope", help="Permission of the key; repeatable.", show_default=False)
]
DaysOption = Annotated[int, typer.Option(help="Lifetime of the key [days].", min=1, max=1825)]


@keys.command("list")
def list_keys(data: Data = None) -> None:
    """List the keys, newest first; their secrets are not stored."""
    now = datetime.now(UTC)
    with account_services(data, "keys list") as services:
        rows = [
            [
                key.id,
                key.name,
                ",".join(sorted(key.scopes)),
                "revoked" if key.revoked_at else "expired" if key.expires_at <= now else "",
                f"{key.expires_at:%Y-%m-%d}",
            ]
            for key in services.keys.all()
        ]
    print_table(["id", "name", "scopes", "state", "expires"], rows)


@keys.command()
def create(
    name: Annotated[str, typer.Argument(help="Name of the key in the audit log.", show_default=False)],
    scope: ScopeOption,
    days: DaysOption = 90,
    data: Data = None,
) -> None:
    """Create a key and print its secret once; the data folder too, if it does not exist."""
    with account_services(data, "keys create", may_create=True) as services:
        made = services.keys.create(name, scope, datetime.now(UTC) + timedelta(days=days), by=BY)
    typer.echo(f"{made.key.id}  {made.key.name}: {', '.join(sorted(made.key.scopes))}")
    typer.echo(f"Send it as `Authorization: Bearer ...`. The secret is shown only now: {made.secret}")


@keys.command()
def revoke(
    key_id: Annotated[str, typer.Argument(help="Id of the key, see `tidegate keys list`.", show_default=False)],
    data: Data = None,
) -> None:
    """Revoke a key permanently."""
    with account_services(data, "keys revoke") as services:
        key = services.keys.revoke(key_id, by=BY)
    typer.echo(f"{key.id}  {key.name} is revoked.")
