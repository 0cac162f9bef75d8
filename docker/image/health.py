"""The image's health check: whether the service answers on its port, by its protocol, under a name that it serves.

Follows TIDEGATE_HOST, TIDEGATE_PORT, TIDEGATE_TLS_CERT, TIDEGATE_ALLOWED_HOSTS, and a --port of the service's command.
Standard library only: it runs every ten seconds beside the service.

With ``--restart-after N`` it kills the service at the N-th failure in a row, for container engines that restart what
has ended but not what is unhealthy. A service that has not answered yet is left alone: it may be upgrading its
database.
"""

import argparse
import http.client
import itertools
import os
import signal
import ssl
import sys
import tempfile
from pathlib import Path

TIMEOUT_S = 2.0
PROC = Path("/proc")
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - addresses that a listening service is not called by


def main() -> int:
    """Return 0 where the service answers, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--restart-after", type=int, metavar="N", help="kill the service at the N-th failure in a row")
    parser.add_argument("--state", type=Path, default=Path(tempfile.gettempdir()) / "tidegate-health")
    asked = parser.parse_args()
    trouble = trouble_of(dict(os.environ), _port_of_command())
    if trouble is not None:
        sys.stdout.write(f"{trouble}\n")
    if asked.restart_after is not None:
        _count(asked.state, asked.restart_after, is_healthy=trouble is None)
    return int(trouble is not None)


def trouble_of(environment: dict[str, str], port: int | None) -> str | None:
    """Return why the service is not healthy; None if it is."""
    try:
        status = _ask(environment, port or int(environment.get("TIDEGATE_PORT", "8000")))
    except (OSError, http.client.HTTPException) as error:
        return f"no answer: {error}"
    return None if status == http.client.OK else f"answered with {status}"


def _ask(environment: dict[str, str], port: int) -> int:
    host = environment.get("TIDEGATE_HOST", "127.0.0.1")
    host = EVERYWHERE.get(host, host)
    if environment.get("TIDEGATE_TLS_CERT"):
        # Whether the service answers, not who it is: the certificate names the hospital's address, not this one.
        context = ssl._create_unverified_context()  # noqa: S323, SLF001
        connection: http.client.HTTPConnection = http.client.HTTPSConnection(
            host, port, timeout=TIMEOUT_S, context=context
        )
    else:
        connection = http.client.HTTPConnection(host, port, timeout=TIMEOUT_S)
    try:
        connection.request("GET", "/healthz", headers={"Host": _served_name(environment, port)})
        return connection.getresponse().status
    finally:
        connection.close()


def _served_name(environment: dict[str, str], port: int) -> str:
    names = [name.strip() for name in environment.get("TIDEGATE_ALLOWED_HOSTS", "").split(",") if name.strip()]
    name = next((name for name in names if name != "*"), "127.0.0.1")
    return f"{name}:{port}"


def _count(state: Path, most: int, *, is_healthy: bool) -> None:
    """Count failures in a row in ``state``, which exists only once the service has answered."""
    if is_healthy:
        state.write_text("0")
    elif state.exists():
        failures = int(state.read_text() or 0) + 1
        state.write_text(str(failures))
        if failures >= most:
            state.unlink()
            for pid in services():
                sys.stdout.write(f"killed the service ({pid}) after {failures} failures\n")
                os.kill(pid, signal.SIGKILL)


def services(proc: Path = PROC) -> list[int]:
    """Return the process ids of ``tidegate serve``."""
    return [pid for pid, words in _commands(proc) if _is_service(words)]


def _commands(proc: Path = PROC) -> list[tuple[int, list[str]]]:
    found = []
    for folder in proc.iterdir():
        if folder.name.isdecimal() and int(folder.name) != os.getpid():
            try:
                found.append((int(folder.name), (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")))
            except OSError:
                continue  # it has ended
    return found


def _is_service(words: list[str]) -> bool:
    """Whether these are Python's words for ``tidegate serve``; an init that started it is not it."""
    return "python" in words[0] and any(
        name.endswith("tidegate") and then == "serve" for name, then in itertools.pairwise(words)
    )


def _port_of_command() -> int | None:
    """Return the --port of the running service's command; None without one."""
    for _, words in _commands():
        if not _is_service(words):
            continue
        for word, then in zip(words, [*words[1:], ""], strict=True):
            value = word.removeprefix("--port=") if word.startswith("--port=") else then if word == "--port" else ""
            if value.isdecimal():
                return int(value)
    return None


if __name__ == "__main__":
    sys.exit(main())
