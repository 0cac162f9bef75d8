"""Everything one campaign worker has: a real service on a virtual camera, a receiver in its own process, and a person.

The service is ``tidegate serve`` in a data folder of its own; the camera is a live device of the real OpenNI2 runtime;
the beam line is Modbus TCP. Whatever is broken on purpose is mended here, or thrown away with the rig.
"""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from engine.core.clock import NS_PER_S
from service.core.settings.settings import Settings
from service.storage.files.journals import Journals
from tests.support.beam.modbus_server import COIL, INPUT, REGISTER, UNIT
from tests.support.beam.receivers import Receiver
from tests.support.engine_process.process_ids import engine_pid, engine_pids
from tests.support.repository import ROOT
from tests.support.scheduling_monitor import Watchman
from tests.support.service.accounts import EVERY_ROLE, provision
from tests.support.service.processes import free_port
from tests.support.site_settings import with_config
from tests.support.virtual_camera.camera import CameraSilentError, VirtualXtion
from verification.faults import engine_program
from verification.faults.audit_reader import Ledger
from verification.faults.operator import NAME, Person, PersonGaveUpError
from verification.faults.plan import Plan
from verification.faults.verdict import LineEdge, is_on_at
from verification.faults.wall_clock import WallClock

WINDOW_MM = 30.0
WINDOW = {"signal": "whole", "lower_mm": -WINDOW_MM, "upper_mm": WINDOW_MM, "hysteresis_mm": 0.2, "dwell_ms": 100.0}
TMPFS_MB, FREE_MB, WORN_MB = 192, 24, 90
RECEIVER_NICE = -15
MEMORY = Path("/dev/shm")
"""Where a real service's journals lie; those of the tests' own process lie elsewhere."""

DATABASE = "tidegate.db"
SETTINGS = {
    "BEAM_LINE": "modbus-tcp",
    "BEAM_MODBUS_HOST": "127.0.0.1",
    "BEAM_MODBUS_UNIT": UNIT,
    "BEAM_MODBUS_PERMIT_COIL": COIL,
    "BEAM_MODBUS_HEARTBEAT_REGISTER": REGISTER,
    "BEAM_MODBUS_READBACK_INPUT": INPUT,
    "MIN_FREE_DISK_MB": FREE_MB,
    "SESSION_ROOM_MIN": 1,
    "LIKENESS_MAX_SHIFT_MM": 60.0,
    "MAX_DUTY_PERCENT": 100,
    "WARM_UP_MIN": 0,
}
"""All else as it comes: the campaign judges the defaults. The beam may be on during the whole breath, so that it is on
when a fault comes."""


class NotMountedError(Exception):
    """This machine does not let a small file system be mounted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """A data folder in which one session was learned: every rig begins with a copy."""

    folder: Path
    calibration_id: str
    model_id: str

    @property
    def session_request(self) -> dict[str, Any]:
        return {"calibration_id": self.calibration_id, "model_id": self.model_id}


class Rig:
    """See the module; a context manager."""

    def __init__(self, folder: Path, plan: Plan, template: Template | None) -> None:
        self.folder, self.plan, self.template = folder, plan, template
        self.data = folder / "data"
        self.ledger = Ledger(self.data / DATABASE)
        self._held = contextlib.ExitStack()
        self._log_number = 0
        self._old_edges: list[list[str]] = []
        self.session_request: dict[str, Any] = {} if template is None else template.session_request
        self.window: dict[str, object] = dict(WINDOW)
        self.window_mm = WINDOW_MM
        self._session_ns = 0
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Rig":
        self.folder.mkdir(parents=True, exist_ok=True)
        self.wall_clock = WallClock(self.folder)
        with contextlib.ExitStack() as held:
            held.enter_context(_small_disk(self.data))
            self.fill_data()
            self.watchman = Watchman()
            held.callback(self.watchman.end)
            self.receiver = Receiver("tcp")
            self.line_port = int(self.receiver.where)
            _prefer(self.receiver.process.pid)
            held.callback(self.receiver.end)
            self.camera = held.enter_context(VirtualXtion(self.folder))
            self.port = free_port()
            held.callback(self._kill_service)
            origin = f"http://127.0.0.1:{self.port}"
            let_in = provision(self.data, people={NAME: EVERY_ROLE}, origin=origin, settings=self.service_settings)
            self.key_headers = let_in.key
            self.person = Person(self.port, let_in.headers)
            held.callback(self.person.close)
            self.start_service()
            self._held = held.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()
        for left in Journals(self.data, None, memory=MEMORY).left_behind():
            left.unlink()  # of the machine's memory: no start comes that would read it

    def fill_data(self) -> None:
        """Put into the data folder what every rig begins with."""
        if self.template is not None:
            shutil.copytree(self.template.folder, self.data, dirs_exist_ok=True)

    @property
    def service_settings(self) -> Settings | None:
        """Where the service's database is, where that is not the data folder."""
        return None

    # The receiver.

    @property
    def edges(self) -> list[LineEdge]:
        seen = [*self._old_edges, *self.receiver.seen]
        return [
            LineEdge(is_on=words[0] == "on", at_ns=int(words[1]), cause=words[2] if len(words) > 2 else "")
            for words in seen
        ]

    @property
    def is_on(self) -> bool:
        return is_on_at(self.edges, time.monotonic_ns())

    def kill_receiver(self) -> int:
        """Kill it: a contact without its device is open, so that is when the line goes off."""
        was_on = self.is_on
        at_ns = time.monotonic_ns()
        self.receiver.end()
        self._old_edges += self.receiver.seen
        if was_on:
            self._old_edges.append(["off", str(time.monotonic_ns()), "killed"])
        return at_ns

    def replace_receiver(self) -> None:
        self.receiver = Receiver("tcp", self.line_port)
        _prefer(self.receiver.process.pid)

    # The service.

    @property
    def is_alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    def start_service(self) -> None:
        self.begin_service()
        self.person.wait_for_service(lambda: self.is_alive)

    def begin_service(self) -> None:
        """Start it, and do not wait for it."""
        self._log_number += 1
        for left in self.folder.glob("saboteur*"):
            left.unlink()
        command = [
            "verification.faults.service_program",
            str(self.folder / "saboteur"),
            "serve",
            "--data",
            str(self.data),
        ]
        with (self.folder / f"service-{self._log_number}.log").open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", *command, "--port", str(self.port)],
                cwd=ROOT,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment(),
            )

    @property
    def engine_pid(self) -> int:
        """The process of the session's engine."""
        return engine_pid(self.pid, engine_program.MARK)

    def signal(self, number: int, *pids: int) -> int:
        """Send the service a signal, or these of its processes; returns when."""
        at_ns = time.monotonic_ns()
        for pid in pids or (self.pid,):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        return at_ns

    def sabotage(self, *words: object, in_engine: bool = False) -> int:
        """Let the saboteur in the service's process, or in the engine's, act; returns when it did."""
        path = str(self.folder / "saboteur")
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(20.0)
            client.connect(engine_program.path_of(path, self.engine_pid) if in_engine else path)
            client.sendall((" ".join(map(str, words)) + "\n").encode())
            with client.makefile() as lines:
                answer = lines.readline().split(maxsplit=1)
        if not answer or answer[0] != "done":
            raise PersonGaveUpError(f"{words}: {answer}")
        return int(answer[1])

    def end_service(self) -> None:
        """Let it end as it would by itself, everything written."""
        self.signal(signal.SIGTERM)
        assert self.process is not None
        self.process.wait(30.0)

    def _environment(self) -> dict[str, str]:
        settings = {**SETTINGS, "BEAM_MODBUS_PORT": self.line_port, **self.plan.settings}
        reported = {f"TIDEGATE_{name}": str(value) for name, value in settings.items()}
        clock = self.wall_clock.environment if self.plan.has_own_clock else {}
        return with_config({**os.environ, **self.camera.environment, **reported, **clock}, self.folder)

    def _kill_service(self) -> None:
        if self.process is not None:
            engines = engine_pids(self.pid, engine_program.MARK)
            self.signal(signal.SIGCONT, self.pid, *engines)
            self.process.kill()
            self.process.wait()
            self.signal(signal.SIGKILL, *engines)

    # The camera.

    def mend_camera(self) -> int | None:
        """Undo all that the camera was reported; return when the first good frame was raised, if one was."""
        if not self.is_alive:
            return None  # what it was sent died with the process
        with contextlib.suppress(CameraSilentError):
            receipt = self.camera.undo()
            return receipt.raised_ns if receipt.depth_ns is not None else None
        return None

    @property
    def beam_on_s(self) -> float:
        """How long the beam was on in this session: beyond two breaths the gate holds, as the window is never left."""
        edges, now_ns = [edge for edge in self.edges if edge.at_ns >= self._session_ns], time.monotonic_ns()
        times = [*edges, LineEdge(is_on=False, at_ns=now_ns, cause="")]
        return sum(off.at_ns - on.at_ns for on, off in pairwise(times) if on.is_on) / NS_PER_S

    def new_session(self) -> None:
        """Make and start a session on the camera, with the stored model where there is one."""
        self._session_ns = time.monotonic_ns()
        source = {"kind": "device", "uri": None}
        self.person.make_session({"source": source, "window": self.window, **self.session_request})

    @property
    def worn_mb(self) -> float:
        """How much the data folder holds: a rig that holds much is replaced."""
        return sum(path.stat().st_size for path in self.data.rglob("*") if path.is_file()) / 2**20


@contextlib.contextmanager
def _small_disk(folder: Path) -> Iterator[None]:
    """Mount a small file system in memory: a full disk is nothing to play with on a real one."""
    folder.mkdir(parents=True, exist_ok=True)
    options = f"size={TMPFS_MB}m"
    mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    done = subprocess.run(mount, check=False, capture_output=True, text=True)
    if done.returncode:
        raise NotMountedError(done.stderr.strip())
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=False, capture_output=True)


def _prefer(pid: int) -> None:
    """Let a stand-in for hardware be woken in time: a real receiver does not share a processor with anyone."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, RECEIVER_NICE)
