"""What a stop takes, with much to end.

Run: ``python -m tests.support.service.shutdown_cases`` prints docs/3-operate/monitoring.md's table.

Each row is a service process that is asked to end by SIGTERM while all that its name says goes on.
"""

import argparse
import contextlib
import signal
import sqlite3
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.connected_clients import crowd
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually

NS_PER_S = 1e9
LONGEST_STOP_S = 5.0
HUNG_S = 3.0
"""As long as `service.engine_host.local_engine` waits for an engine whose beam line does not answer."""
AN_HOUR = 108_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What goes on when the signal comes."""

    name: str
    sockets: int = 0
    deaf_sockets: int = 0
    rows: int = 30
    hang_s: float = 0.0
    is_busy: bool = False
    has_events: bool = False
    signals: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """What became of it."""

    held_s: float
    ended_s: float
    code: int
    rows: tuple[str, ...]
    status: str
    log: str


CASES = (
    Case(name="a session"),
    Case(name="200 live clients, 10 of which do not read", sockets=190, deaf_sockets=10),
    Case(name="a slow download, half a body, a stream of events", rows=12_000, is_busy=True, has_events=True),
    Case(name="an hour of samples", rows=AN_HOUR),
    Case(name="a beam line that does not answer", hang_s=HUNG_S),
    Case(
        name="all of it at once",
        sockets=190,
        deaf_sockets=10,
        rows=AN_HOUR,
        hang_s=HUNG_S,
        is_busy=True,
        has_events=True,
    ),
)


def end(case: Case, folder: Path) -> Ending:
    """Start a service, bring it about, tell it to end, and look at what it left."""
    (folder / "chest.oni").write_bytes(b"")
    port, data = free_port(), folder / "data"
    arguments = (
        "tests.support.service.shutdown_program",
        str(data),
        str(folder),
        str(port),
        str(case.rows),
        str(case.hang_s),
    )
    with service_process(*arguments, port=port, log=folder / "log", data=data) as (process, client):
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        eventually(lambda: "driven" in (folder / "log").read_text(), within_s=120.0)
        with crowd(port, client.key_headers) as people:
            for number in range(case.sockets + case.deaf_sockets):
                people.watch(reads=number < case.sockets)
            if case.is_busy:
                people.download_slowly(f"/api/v1/sessions/{session_id}/samples?format=csv")
                people.send_half("/api/v1/sessions")
            if case.has_events:
                people.listen()
            began_ns = time.monotonic_ns()
            process.send_signal(signal.SIGTERM)
            for _ in range(case.signals - 1):
                time.sleep(0.3)  # a person who presses again
                process.send_signal(signal.SIGINT)
            code = process.wait(30.0)
            ended_ns = time.monotonic_ns()
    log = (folder / "log").read_text()
    (held_ns,) = (int(line.split()[1]) for line in log.splitlines() if line.startswith("held "))
    with contextlib.closing(sqlite3.connect(data / "tidegate.db")) as raw:
        rows = tuple(row for (row,) in raw.execute("SELECT action FROM audit ORDER BY sequence"))
        (status,) = raw.execute("SELECT status FROM sessions").fetchone()
    return Ending(
        held_s=(held_ns - began_ns) / NS_PER_S,
        ended_s=(ended_ns - began_ns) / NS_PER_S,
        code=code,
        rows=rows,
        status=status,
        log=log,
    )


def table(cases: tuple[Case, ...]) -> str:
    """Bring every case about, and write a row for each."""
    lines = [
        "| when the signal comes there is | engine ended after [s] | process gone after [s] | exit |",
        "|---|---|---|---|",
    ]
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            found = end(case, Path(folder))
        lines.append(f"| {case.name} | {found.held_s:.2f} | {found.ended_s:.2f} | {found.code} |")
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="the row with these words alone")
    chosen = parser.parse_args(arguments).only
    sys.stdout.write(f"{table(tuple(case for case in CASES if chosen is None or chosen in case.name))}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
