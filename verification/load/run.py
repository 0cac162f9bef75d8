"""One run: a session, quiet and loaded blocks in turn, and what each of them was."""

import contextlib
import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.support.access.tls_certificate import make_certificate
from verification.load.frames import Block, read_frames
from verification.load.interruption import Ending
from verification.load.login_flood import Flood
from verification.load.program_protocol import trusted_by
from verification.load.programs import LoadProgram
from verification.load.recording import base_folder, write_long
from verification.load.service import (
    Service,
    learn,
    samples_of,
    served,
    start_session,
    stop_session,
    transitions_of,
)
from verification.load.usage import Usage, machine_busy_s, usage_of

ARM_S = 30.0
CHANGE_S = 40.0
"""What a round takes beside its blocks, at most: programs that open the clients of a loaded one, and close them."""
SETTLE_S = 1.0
LOOK_EVERY_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What is asked for; the watchers' last ``events`` get server-sent events, their first ``stalled`` never read."""

    dashboards: int = 200
    events: int = 0
    stalled: int = 0
    stream_query: str = ""
    requests_per_s: float = 50.0
    export: str | None = "csv"
    is_holding: bool = True
    is_flooded: bool = False
    rounds: int = 4
    quiet_s: float = 10.0
    loaded_s: float = 20.0
    checkout: Path | None = None
    database_url: str | None = None
    has_tls: bool = False

    @property
    def seconds(self) -> float:
        """How long the recording has to be."""
        return ARM_S + self.rounds * (self.quiet_s + self.loaded_s + CHANGE_S)


@dataclass(slots=True)
class Counted:
    """What the blocks of one kind used and saw."""

    blocks: list[Block] = field(default_factory=list)
    usage: list[tuple[Usage, Usage]] = field(default_factory=list)
    machine_busy_s: float = 0.0
    own_s: float = 0.0
    watchers: list[dict[str, Any]] = field(default_factory=list)
    callers: list[dict[str, Any]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """How long all blocks were."""
        return sum(block.seconds for block in self.blocks)

    @property
    def processor_s(self) -> float:
        """What the service used of the cores [s]."""
        return sum(after.processor_s - before.processor_s for before, after in self.usage)

    @property
    def waited_s(self) -> float:
        """For how long the service's threads wanted a core that others had [s]."""
        return sum(after.waited_s - before.waited_s for before, after in self.usage)

    @property
    def others_cores(self) -> float:
        """How many cores others had: neither the service nor those who make the load."""
        return max(0.0, self.machine_busy_s - self.processor_s - self.own_s) / max(self.seconds, 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """All that is known of a run."""

    load: Load
    frames: Any
    session: dict[str, Any]
    transitions: int
    quiet: Counted
    loaded: Counted
    begun_s: float
    ended_s: float
    ready_s: float
    idle: Usage
    memory: list[Usage]
    answers: dict[str, int]
    load_averages: tuple[float, float]
    log: str
    is_cut_short: bool = False


class MemoryWatch:
    """Looks at a process every few seconds until the block ends."""

    def __init__(self, process_id: int, every_s: float = LOOK_EVERY_S) -> None:
        self._process_id, self._every_s = process_id, every_s
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self.seen: list[Usage] = []

    def __enter__(self) -> "MemoryWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()
        self.seen.append(usage_of(self._process_id))

    def _look(self) -> None:
        while True:
            self.seen.append(usage_of(self._process_id))
            if self._is_over.wait(self._every_s):
                return


def run(load: Load, on_step: Callable[[str], None] = lambda _step: None, ending: Ending | None = None) -> Outcome:
    """Do everything, and tell what it came to; once asked for the end, what it has come to so far."""
    ending = ending or Ending()
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="tidegate-load-") as made:
        place = Path(made)
        (place / "recordings").mkdir()
        recording = place / "recordings" / "recording.oni"
        on_step("making the recording")
        folder = base_folder()
        write_long(folder / "recording.oni", load.seconds, recording)
        tls = make_certificate(place) if load.has_tls else None
        with served(
            place, recording.parent, checkout=load.checkout, environment=_environment(load), tls=tls
        ) as service:
            idle = usage_of(service.process.pid)
            on_step("learning")
            session_id = start_session(service, recording, learn(service, folder, recording))
            begun_s = time.monotonic()
            quiet, loaded = Counted(), Counted()
            with MemoryWatch(service.process.pid) as memory:
                ending.measuring()
                answers = _rounds(load, service, session_id, quiet, loaded, on_step, ending)
            on_step("closing the session")
            ended_s = time.monotonic()
            session = stop_session(service, session_id)
            frames = read_frames(samples_of(service, session_id))
            transitions = transitions_of(service, session_id)
        log = service.log.read_text(errors="replace")
    return Outcome(
        load=load,
        frames=frames,
        session=session,
        transitions=transitions,
        quiet=quiet,
        loaded=loaded,
        begun_s=begun_s,
        ended_s=ended_s,
        ready_s=service.ready_s,
        idle=idle,
        memory=memory.seen,
        answers=answers,
        load_averages=(before, os.getloadavg()[0]),
        log=log,
        is_cut_short=ending.is_asked,
    )


def _environment(load: Load) -> dict[str, str]:
    # The flood comes from made-up addresses, which only a proxy may tell.
    flood = {"TIDEGATE_BEHIND_PROXY": "true", "TIDEGATE_ALLOWED_HOSTS": "127.0.0.1"} if load.is_flooded else {}
    return flood | ({"TIDEGATE_DATABASE_URL": load.database_url} if load.database_url else {})


def _rounds(
    load: Load,
    service: Service,
    session_id: str,
    quiet: Counted,
    loaded: Counted,
    on_step: Callable[[str], None],
    ending: Ending,
) -> dict[str, int]:
    answers: Counter[str] = Counter()
    for number in range(load.rounds):
        on_step(f"round {number + 1} of {load.rounds}: quiet")
        time.sleep(SETTLE_S)
        with _counting(quiet, "quiet", service):
            ending.sleep(load.quiet_s)
        service.require_alive()
        if ending.is_asked:
            break
        on_step(f"round {number + 1} of {load.rounds}: loaded")
        answers.update(_loaded_block(load, service, session_id, loaded, ending))
        service.require_alive()
        if ending.is_asked:
            break
    return dict(answers)


def _loaded_block(load: Load, service: Service, session_id: str, loaded: Counted, ending: Ending) -> Mapping[str, int]:
    """Let everybody watch and call; what they open is not counted, nor anything of clients that were ended before."""
    with _programs(load, service, session_id) as programs, _flood(load, service) as flood:
        for program in programs:
            program.wait_until_ready()
        ending.sleep(SETTLE_S)
        if ending.is_asked:
            return {}
        for program in programs:
            program.begin()
        with _counting(loaded, "loaded", service):
            ending.sleep(load.loaded_s)
        watchers, callers = (program.result() for program in programs)
    loaded.watchers.append(watchers)
    loaded.callers.append(callers)
    loaded.own_s += watchers["processor_s"] + callers["processor_s"]
    return Counter(callers["answers"]) + Counter(flood)


@contextlib.contextmanager
def _counting(counted: Counted, kind: str, service: Service) -> Iterator[None]:
    before, busy_s, own_s, begin_s = (
        usage_of(service.process.pid),
        machine_busy_s(),
        time.process_time(),
        time.monotonic(),
    )
    yield
    counted.blocks.append(Block(kind=kind, begin_s=begin_s, end_s=time.monotonic()))
    counted.usage.append((before, usage_of(service.process.pid)))
    counted.machine_busy_s += machine_busy_s() - busy_s
    counted.own_s += time.process_time() - own_s


@contextlib.contextmanager
def _programs(load: Load, service: Service, session_id: str) -> Iterator[tuple[LoadProgram, LoadProgram]]:
    speaking: dict[str, object] = {"port": service.port, "authorization": service.authorization}
    if service.certificate is not None:
        speaking["certificate"] = str(service.certificate)
    watching = {"clients": load.dashboards, "events": load.events, "stalled": load.stalled, "query": load.stream_query}
    calling = {"session_id": session_id, "per_s": load.requests_per_s, "is_holding": load.is_holding}
    with (
        LoadProgram("verification.load.watchers", speaking | watching) as watchers,
        LoadProgram("verification.load.callers", speaking | calling | {"export": load.export}) as callers,
    ):
        yield watchers, callers


@contextlib.contextmanager
def _flood(load: Load, service: Service) -> Iterator[dict[str, int]]:
    answers: dict[str, int] = {}
    if not load.is_flooded:
        yield answers
        return
    with Flood(service.port, trusted_by({"certificate": service.certificate})) as flood:
        yield answers
    answers.update({f"log-in {status}": count for status, count in flood.answers.items()})
