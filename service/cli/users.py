"""``tidegate users``: who may log in, on a data folder that no service uses."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from service.access.passwords import MAX_LENGTH, check_password
from service.access.people import Change, Issued
from service.access.permissions import Role
from service.cli.people import BY, DataOption, desks_of, say, table_of

users = typer.Typer(
    name="users",
    help="Who may log in, on a data folder that no service uses.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
Data = Annotated[Path | None, DataOption]
Name = Annotated[str, typer.Argument(help="As it is typed at the log-in.", show_default=False)]
RoleOption = Annotated[list[Role], typer.Option("--role", help="Repeatable.", show_default=False)]
FromStdin = Annotated[
    bool, typer.Option("--password-stdin", help="Read the password from standard input; it stays as it is.")
]


@users.command("list")
def list_users(data: Data = None) -> None:
    """List everybody."""
    with desks_of(data, "users") as desks:
        rows = [
            [
                user.name,
                ",".join(sorted(user.roles)),
                "disabled" if user.is_disabled else "must change password" if user.must_change_password else "",
                "break-glass" if user.is_break_glass else "",
                user.issuer or "",
            ]
            for user in desks.people.all()
        ]
    table_of(["name", "roles", "state", "", "kept by"], rows)


@users.command()
def add(
    name: Name,
    role: RoleOption,
    data: Data = None,
    password_stdin: FromStdin = False,
    break_glass: Annotated[
        bool, typer.Option("--break-glass", help="May log in by password while the identity provider is on.")
    ] = False,
) -> None:
    """Make a person: with a password from standard input, or one that is made here and has to be changed."""
    with desks_of(data, "users") as desks:
        password = _password(name) if password_stdin else None
        _tell(desks.people.add(name, role, by=BY, password=password, is_break_glass=break_glass))


@users.command()
def reset(name: Name, data: Data = None) -> None:
    """Make a new password for somebody, to be changed at the next log-in; ends their log-ins."""
    with desks_of(data, "users") as desks:
        _tell(desks.people.change(name, Change(reset_password=True), by=BY))


@users.command()
def disable(name: Name, data: Data = None) -> None:
    """Let somebody in no more; nobody is ever deleted."""
    with desks_of(data, "users") as desks:
        desks.people.change(name, Change(is_disabled=True), by=BY)
    say(f"{name} is disabled.")


@users.command()
def enable(name: Name, data: Data = None) -> None:
    """Let somebody in again."""
    with desks_of(data, "users") as desks:
        desks.people.change(name, Change(is_disabled=False), by=BY)
    say(f"{name} may log in again.")


def _tell(issued: Issued) -> None:
    say(f"{issued.user.name}: {', '.join(sorted(issued.user.roles))}")
    if issued.one_time_password is not None:
        say(f"Password, told once and to be changed at the first log-in: {issued.one_time_password}")


def _password(name: str) -> str:
    """Read one line; longer than any password is cut, and refused by that."""
    given = sys.stdin.readline(MAX_LENGTH + 2).rstrip("\r\n")
    check_password(given, name)
    return given
