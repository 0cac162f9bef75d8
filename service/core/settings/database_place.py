"""Where the database is: the file in the data folder, or a PostgreSQL server that a URL names."""

import ipaddress
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import SecretStr

if TYPE_CHECKING:  # the engine's process does without SQLAlchemy
    from sqlalchemy import URL

DATABASE_NAME = "tidegate.db"
DRIVER = "postgresql+psycopg"
SCHEMES = ("postgresql", "postgres", DRIVER)
PLAIN_SCHEMES = " or ".join(f"{name}://" for name in SCHEMES[:2])
MAX_PASSWORD = 1024


def place_of(url: SecretStr | None, password_file: Path | None, data_dir: Path) -> "Path | URL":
    """Return what :class:`service.storage.database.engine.Database` opens.

    Raises
    ------
    ValueError
        The URL or the password file cannot be used; the message never holds the password.
    """
    if url is None:
        if password_file is not None:
            msg = "database_password_file belongs to database_url, which is not given"
            raise ValueError(msg)
        return data_dir / DATABASE_NAME
    return _with_password(_server_url(url.get_secret_value()), password_file)


def shown_place(place: "Path | URL") -> str:
    """Write down where a database is, for a person or a log; never with its password."""
    return str(place) if isinstance(place, Path) else place.set(password=None, query={}).render_as_string()


def _server_url(text: str) -> "URL":
    from sqlalchemy import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(text)
    except ArgumentError as error:
        msg = f"database_url must begin with {PLAIN_SCHEMES}"
        raise ValueError(msg) from error
    if url.drivername not in SCHEMES:
        msg = f"database_url must begin with {PLAIN_SCHEMES}, not with {url.drivername}://"
        raise ValueError(msg)
    if not url.database:
        msg = "database_url must name a database: postgresql://USER@HOST/DATABASE"
        raise ValueError(msg)
    _refuse_silent_plain_text(url)
    return url.set(drivername=DRIVER)


def _refuse_silent_plain_text(url: "URL") -> None:
    """Have it written down how a connection that leaves this machine is secured: left out, it may be in plain text."""
    hosts = [url.host, *_listed(url, "host"), *_listed(url, "hostaddr")]
    if "sslmode" not in url.query and any(not _is_local(host) for host in hosts if host):
        msg = (
            "database_url leads to another machine and must say how that is secured: "
            "?sslmode=verify-full&sslrootcert=FILE (or sslmode=disable where the network itself is closed)"
        )
        raise ValueError(msg)


def _listed(url: "URL", name: str) -> list[str]:
    found = url.query.get(name, ())
    return [one for text in ([found] if isinstance(found, str) else found) for one in text.split(",")]


def _is_local(host: str) -> bool:
    if host.startswith("/") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _with_password(url: "URL", password_file: Path | None) -> "URL":
    if password_file is None:
        return url
    if url.password is not None:
        msg = "database_url has a password and database_password_file names another: give one of them"
        raise ValueError(msg)
    try:
        password = password_file.read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        msg = f"database_password_file {password_file} cannot be read ({type(error).__name__})"
        raise ValueError(msg) from error
    if not 0 < len(password) <= MAX_PASSWORD or "\n" in password:
        msg = f"database_password_file {password_file} must hold one line of 1 to {MAX_PASSWORD} characters"
        raise ValueError(msg)
    return url.set(password=password)
