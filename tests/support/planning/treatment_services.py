"""Services to treat at: a key, a therapist with a password, a calibration, a recording."""

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lab.simulated_tps.delivery import BeamClock
from lab.simulated_tps.fraction import FractionRun, FractionSettings
from lab.simulated_tps.prescription import built_in_plan, prescription_of
from lab.simulated_tps.session_driver import DeliverySettings
from service.client import TidegateClient
from service.core.permissions import Permission, Role
from tests.support.repository import ROOT
from tests.support.service.accounts import provision
from tests.support.service.api_calls import make_calibration
from tests.support.service.processes import _wait_until_it_answers, free_port

SCOPES = (
    Permission.SESSIONS_READ,
    Permission.SESSIONS_RUN,
    Permission.PLANS_WRITE,
    Permission.GATE_ARM,
    Permission.GATE_HOLD,
    Permission.CALIBRATIONS_READ,
    Permission.CALIBRATIONS_WRITE,
    Permission.AUDIT_READ,
)
"""What a planning system's key needs for whole fractions (docs/4-integrate/integration.md)."""

THERAPIST = "A. Therapist"
PASSWORD = "a long enough password"
WINDOW = {"signal": "whole", "lower_mm": -2.5, "upper_mm": 2.0, "dwell_ms": 0.0}
FAST = DeliverySettings(between_s=0.2, beam_timeout_s=60.0, restart_wait_s=30.0)


@dataclass(slots=True, kw_only=True)
class Treating:
    """A service, and how to get at it; may be killed and started again."""

    folder: Path
    command: list[str]
    port: int
    key: str
    environment: dict[str, str]
    process: subprocess.Popen | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        log = self.folder / "log"
        with log.open("a") as output:
            self.process = subprocess.Popen(
                self.command, stdout=output, stderr=subprocess.STDOUT, cwd=ROOT, env=self.environment
            )
        import httpx2

        with httpx2.Client(base_url=self.url) as client:
            _wait_until_it_answers(self.process, client, log)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def client(self) -> TidegateClient:
        return TidegateClient(self.url, key=self.key, operator="Simulated therapist")

    def therapist(self) -> TidegateClient:
        client = TidegateClient(self.url)
        client.log_in(THERAPIST, PASSWORD)
        return client


@contextlib.contextmanager
def treating(folder: Path, *module: str, has_therapist: bool = False, **settings: str) -> Iterator[Treating]:
    """Run a service module, whose arguments may name {data}, {recordings} and {port}, until the block ends."""
    import os

    data, port = folder / "data", free_port()
    people = {THERAPIST: {Role.THERAPIST}} if has_therapist else {}
    made = provision(
        data,
        people=people,
        scopes=SCOPES,
        password=PASSWORD if has_therapist else None,
        origin=f"http://127.0.0.1:{port}",
    )
    reported = {"data": data, "recordings": folder, "port": port}
    room = Treating(
        folder=folder,
        command=[sys.executable, "-m", *(part.format(**reported) for part in module)],
        port=port,
        key=made.key_secret,
        environment={**os.environ, "TIDEGATE_JOURNAL_DIR": str(folder / "journals"), **settings},
    )
    try:
        room.start()
        yield room
    finally:
        if room.process is not None and room.process.poll() is None:
            room.kill()


def quick_room(folder: Path, *options: str, has_therapist: bool = False) -> contextlib.AbstractContextManager[Treating]:
    """Treat at the engine that breathes and gates by itself (tests/support/service/breathing_service.py)."""
    (folder / "chest.oni").write_bytes(b"not read by that engine")
    (folder / "calibration.json").write_text(make_calibration().to_json())
    arguments = ("tests.support.service.breathing_service", "{data}", "{recordings}", "{port}", *options)
    return treating(folder, *arguments, has_therapist=has_therapist)


def fraction_of(
    room: Treating, tps: TidegateClient, folder: Path, *, therapist=None, beam_s=0.8, number=1
) -> FractionRun:
    """Import the plan and the calibration, and prepare to run a fraction."""
    with room.client() as calm:
        prescription = prescription_of(calm.import_plan(built_in_plan()), beam_s=beam_s)
        calibration_id = calm.upload_calibration((room.folder / "calibration.json").read_bytes())["id"]
    source = {"kind": "recording", "path": "chest.oni", "player": "reader"}
    return FractionRun(
        number=1,
        prescription=prescription,
        settings=FractionSettings(source=source, calibration_id=calibration_id, window=WINDOW, delivery=FAST),
        tps=tps,
        therapist=therapist,
        folder=folder,
        on_progress=lambda _: None,
    )


class Elsewhere:
    """Runs something on a thread of its own, and gives its result back."""

    def __init__(self, work) -> None:
        self._found: list[object] = []
        self._work = work
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._found.append(self._work())
        except BaseException as error:  # noqa: BLE001 - given back
            self._found.append(error)

    def result(self, *, within_s: float):
        self._thread.join(within_s)
        assert self._found, f"not done within {within_s} s"
        (found,) = self._found
        if isinstance(found, BaseException):
            raise found
        return found


def clocked(run: FractionRun) -> list[BeamClock]:
    """The beam clocks of the sessions so far."""
    return [driver.clock for driver in run._sessions]
