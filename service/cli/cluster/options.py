"""The options of ``--scheduler``: the address of a Dask scheduler, and the files for TLS."""

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import typer

from engine.core.errors import InvalidValueError

SchedulerAddress = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="Dask scheduler whose workers do the work, e.g. tls://host:8786; needs tidegate[cluster]. Recordings, "
        "calibrations and the output are read and written by path: on a file system that all machines share.",
        metavar="ADDRESS",
    ),
]
AuthorityFile = Annotated[Path | None, typer.Option("--tls-ca", help="Authority of the cluster's certificates, PEM.")]
CertificateFile = Annotated[Path | None, typer.Option("--tls-cert", help="This client's certificate, PEM.")]
KeyFile = Annotated[Path | None, typer.Option("--tls-key", help="Key of this client's certificate, PEM.")]

SCHEMES = ("tls", "tcp")


@dataclass(frozen=True, slots=True, kw_only=True)
class SchedulerOptions:
    """A checked scheduler's address, and the three TLS files; None of them for a scheduler on this machine."""

    address: str
    authority: Path | None = None
    certificate: Path | None = None
    key: Path | None = None


def scheduler_options(
    address: str | None, authority: Path | None, certificate: Path | None, key: Path | None
) -> SchedulerOptions | None:
    """Check the options; None without ``--scheduler``.

    Raises
    ------
    InvalidValueError
        Naming the option: TLS options without a scheduler, an address of another form, a file that is missing, or a
        scheduler on another machine without TLS: it runs what anyone sends to it.
    """
    files = {"tls-ca": authority, "tls-cert": certificate, "tls-key": key}
    if address is None:
        for name, file in files.items():
            if file is not None:
                raise InvalidValueError(name, str(file), "left out without --scheduler")
        return None
    if _scheme(address) == "tls":
        _check_files(files)
    else:
        for name, file in files.items():
            if file is not None:
                raise InvalidValueError(name, str(file), f"left out for {address}: TLS needs tls://HOST:PORT")
        if not _is_loopback(urlsplit(address).hostname or ""):
            bound = "tls://HOST:PORT; without TLS only on this machine, because a scheduler runs what anyone sends it"
            raise InvalidValueError("scheduler", address, bound)
    return SchedulerOptions(address=address, authority=authority, certificate=certificate, key=key)


def _scheme(address: str) -> str:
    form = "tls://HOST:PORT, or tcp://127.0.0.1:PORT on this machine"
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError as error:
        raise InvalidValueError("scheduler", address, form) from error
    is_plain = not (parts.path or parts.query or parts.fragment or parts.username)
    if parts.scheme not in SCHEMES or not parts.hostname or port is None or not is_plain:
        raise InvalidValueError("scheduler", address, form)
    return parts.scheme


def _check_files(files: dict[str, Path | None]) -> None:
    for name, file in files.items():
        if file is None:
            raise InvalidValueError(name, "none", "a PEM file, for a tls:// scheduler")
        if not file.is_file():
            raise InvalidValueError(name, str(file), "a PEM file that exists")


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
