"""``tidegate users``: accounts of people, in a data folder that no service uses."""

import sys
from typing import Annotated

import typer

from service.access.accounts.passwords import MAX_LENGTH, check_password
from service.access.accounts.people import Change, Issued
from service.cli.access.account_services import BY, Data, account_services, print_table
from service.cli.command_group import command_group
from service.core.permissions import Role

users = command_group("users", "Manage the accounts of people, while no service uses the data folder.")
Name = Annotated[str, typer.Argument(help="Name of the account, as typed at log-in.", show_default=False)]
RoleOption = Annotated[list[Role], typer.Option("--role", help="Role; repeatable.", show_default=False)]
FromStdin = Annotated[
    bool, typer.Option("--password-stdin", help="Read the password from standard input; it need not be changed.")
]


@users.command("list")
def list_users(data: Data = None) -> None:
    """List all accounts."""
    with account_services(data, "users list") as services:
        rows = [
            [
                user.name,
                ",".join(sorted(user.roles)),
                "disabled" if user.is_disabled else "must change password" if user.must_change_password else "",
                "break-glass" if user.is_break_glass else "",
                user.issuer or "",
            ]
            for user in services.people.all()
        ]
    print_table(["name", "roles", "state", "", "identity provider"], rows)


@users.command()
def add(
    name: Name,
    role: RoleOption,
    data: Data = None,
    password_stdin: FromStdin = False,
    break_glass: Annotated[
        bool, typer.Option("--break-glass", help="May log in by password while the identity provider is in use.")
    ] = False,
) -> None:
    """Create an account; the data folder too, if it does not exist.

    Without --password-stdin a one-time password is generated and printed; it must be changed at the first log-in.
    """
    with account_services(data, "users add", may_create=True) as services:
        password = _password(name) if password_stdin else None
        _print_issued(services.people.add(name, role, by=BY, password=password, is_break_glass=break_glass))


@users.command()
def reset(name: Name, data: Data = None) -> None:
    """Generate a new one-time password for an account and end its log-ins."""
    with account_services(data, "users reset") as services:
        _print_issued(services.people.change(name, Change(reset_password=True), by=BY))


@users.command()
def disable(name: Name, data: Data = None) -> None:
    """Disable an account; accounts are never deleted, since the audit log names them."""
    with account_services(data, "users disable") as services:
        services.people.change(name, Change(is_disabled=True), by=BY)
    typer.echo(f"{name} is disabled.")


@users.command()
def enable(name: Name, data: Data = None) -> None:
    """Enable a disabled account."""
    with account_services(data, "users enable") as services:
        services.people.change(name, Change(is_disabled=False), by=BY)
    typer.echo(f"{name} is enabled.")


def _print_issued(issued: Issued) -> None:
    typer.echo(f"{issued.user.name}: {', '.join(sorted(issued.user.roles))}")
    if issued.one_time_password is not None:
        typer.echo(f"One-time password, shown only now, to be changed at the first log-in: {issued.one_time_password}")


def _password(name: str) -> str:
    """Read one line; a line longer than any password is cut and then refused."""
    given = sys.stdin.readline(MAX_LENGTH + 2).rstrip("\r\n")
    check_password(given, name)
    return given
