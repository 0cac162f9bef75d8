"""When a service is killed: over its whole life, most often where it hurts."""

import contextlib
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import httpx2

from engine.core.clock import NS_PER_S
from verification.faults.kinds import MissedError
from verification.faults.operator import NAME, PersonGaveUpError
from verification.faults.recovery import WayBack

if TYPE_CHECKING:
    from verification.kills.rig import KillRig

START_S = 3.5
"""How long a start takes on a machine of this size, with its migrations."""

BREATH_S = 348 / 29.97 / 3
"""The virtual volunteer's (tests/support/virtual_camera/film.py).

The next edge of the same direction comes about then.
"""

EDGE_S = 0.03
PATIENCE_S = 25.0
LOOK_S = 0.0005
MEASURING_S = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Strike:
    """A kill that was done; ``measured_from_ns`` is since when frames were measured for certain."""

    killed_ns: int
    measured_from_ns: int | None = None
    has_session: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """One kind of moment, and how many of a hundred kills are done there."""

    code: str
    what: str
    strike: Callable[["KillRig", random.Random], Strike]
    share: int
    is_fresh: bool = False


def kill(rig: "KillRig") -> int:
    """Kill -9 the service; returns when."""
    at_ns = time.monotonic_ns()
    with contextlib.suppress(ProcessLookupError):
        os.kill(rig.pid, signal.SIGKILL)
    assert rig.process is not None
    rig.process.wait()
    return at_ns


def _idle(rig: "KillRig", chance: random.Random) -> Strike:
    time.sleep(chance.uniform(0.0, 0.5))
    return Strike(killed_ns=kill(rig), has_session=False)


def _starting(rig: "KillRig", chance: random.Random) -> Strike:
    kill(rig)
    rig.begin_service()
    time.sleep(chance.uniform(0.0, START_S))
    return Strike(killed_ns=kill(rig), has_session=False)


def _recovering(rig: "KillRig", chance: random.Random) -> Strike:
    """Kill with the beam on or about to be, then once or twice more while the next start puts it in order."""
    struck = _beam(rig, chance)
    for _ in range(chance.choice((1, 2))):
        rig.begin_service()
        rig.await_opened_data(chance.uniform(0.0, 0.8))
        kill(rig)
    return struck


def _creating(rig: "KillRig", chance: random.Random) -> Strike:
    asked = _ask(lambda: rig.person.create_session(rig.session_body))
    time.sleep(chance.uniform(0.0, 0.06))
    killed_ns = kill(rig)
    asked.join()
    return Strike(killed_ns=killed_ns, has_session=False)


def _session_starts(rig: "KillRig", chance: random.Random) -> Strike:
    rig.person.create_session(rig.session_body)
    asked = _ask(lambda: rig.person.act("start"))
    time.sleep(chance.uniform(0.0, 0.8))
    killed_ns = kill(rig)
    asked.join()
    return Strike(killed_ns=killed_ns)


def _logging_in(rig: "KillRig", chance: random.Random) -> Strike:
    """Somebody logs in, somebody else is made, a key is asked for: what writes people down."""
    body = {"name": f"K. {chance.randrange(10**9)}", "roles": ["viewer"]}
    calls = (
        lambda: rig.person.post_as_is("/login", {"name": NAME, "password": "not the one it is"}),
        lambda: rig.person.post_as_is("/users", body),
    )
    asked = [_ask(call) for call in calls]
    time.sleep(chance.uniform(0.0, 0.3))
    killed_ns = kill(rig)
    for one in asked:
        one.join()
    return Strike(killed_ns=killed_ns, has_session=False)


def _measuring(rig: "KillRig", chance: random.Random) -> Strike:
    rig.new_session()
    since_ns = _await_measuring(rig)
    time.sleep(chance.uniform(0.0, 2.0))
    return Strike(killed_ns=kill(rig), measured_from_ns=since_ns)


def _arming(rig: "KillRig", chance: random.Random) -> Strike:
    rig.new_session()
    since_ns = _await_measuring(rig)
    rig.person.act("reference", at="now", reason="anywhere")
    asked = _ask(lambda: _arm(rig))
    time.sleep(chance.uniform(0.0, 0.25))
    killed_ns = kill(rig)
    asked.join()
    return Strike(killed_ns=killed_ns, measured_from_ns=since_ns)


def _arm(rig: "KillRig") -> None:
    for _ in range(20):
        if rig.person.act("arm").status_code == httpx2.codes.OK:
            return


def _beam(rig: "KillRig", chance: random.Random) -> Strike:
    since_ns = _reach_beam(rig)
    time.sleep(chance.uniform(0.0, 2.5))
    return Strike(killed_ns=kill(rig), measured_from_ns=since_ns)


def _behind_edge(rig: "KillRig", chance: random.Random) -> Strike:
    """Kill within 30 ms of an edge that was just seen, most often within a few."""
    since_ns = _reach_beam(rig)
    after_s = chance.choice((chance.uniform(0.0, 0.005), chance.uniform(0.0, EDGE_S)))
    _await_edge(rig, chance.random() < 0.6)
    time.sleep(after_s)
    return Strike(killed_ns=kill(rig), measured_from_ns=since_ns)


def _around_edge(rig: "KillRig", chance: random.Random) -> Strike:
    """Kill around the edge that is due a breath after one that was seen."""
    since_ns = _reach_beam(rig)
    edge_ns = _await_edge(rig, chance.random() < 0.5)
    due_s = edge_ns / NS_PER_S + BREATH_S + chance.uniform(-EDGE_S, EDGE_S)
    time.sleep(max(0.0, due_s - time.monotonic()))
    return Strike(killed_ns=kill(rig), measured_from_ns=since_ns)


def _stopping(rig: "KillRig", chance: random.Random) -> Strike:
    """Kill while the session is closed and its samples turned into their last form."""
    since_ns = _reach_beam(rig)
    asked = _ask(lambda: rig.person.act("stop"))
    time.sleep(chance.uniform(0.0, 0.5))
    killed_ns = kill(rig)
    asked.join()
    return Strike(killed_ns=killed_ns, measured_from_ns=since_ns)


def _backing_up(rig: "KillRig", chance: random.Random) -> Strike:
    """Kill service and backup while one is made of a session that runs."""
    since_ns = _reach_beam(rig)
    with rig.backup() as process:
        time.sleep(chance.uniform(0.5, 4.0))
        killed_ns = kill(rig)
        process.kill()
    return Strike(killed_ns=killed_ns, measured_from_ns=since_ns)


def _first_start(rig: "KillRig", chance: random.Random) -> Strike:
    """Kill the very first start of all: the tables are made."""
    kill(rig)
    rig.empty_data()
    rig.begin_service()
    time.sleep(chance.uniform(0.3, START_S))
    return Strike(killed_ns=kill(rig), has_session=False)


def _ask(call: Callable[[], object]) -> threading.Thread:
    """Send from a thread of its own, since the server is about to be killed."""

    def ask() -> None:
        with contextlib.suppress(httpx2.HTTPError, OSError, PersonGaveUpError, ValueError, RuntimeError):
            call()

    thread = threading.Thread(target=ask)
    thread.start()
    return thread


def _reach_beam(rig: "KillRig") -> int:
    way = WayBack(rig)
    if way.walk() is None:
        raise MissedError(f"the beam does not come on: {way.refusal}")
    return time.monotonic_ns()


def _await_measuring(rig: "KillRig") -> int:
    end_s = time.monotonic() + MEASURING_S
    while rig.person.detail()["measurement_state"] != "measuring":
        if time.monotonic() > end_s:
            raise MissedError("nothing is measured")
        time.sleep(0.05)
    return time.monotonic_ns()


def _await_edge(rig: "KillRig", is_on: bool) -> int:
    """Wait for the next edge of this direction; a session that faults is put right meanwhile."""
    since_ns = time.monotonic_ns()
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        newest = rig.newest_edge
        if newest is not None and newest.is_on is is_on and newest.at_ns > since_ns:
            return newest.at_ns
        if time.monotonic_ns() - since_ns > 6 * NS_PER_S and not rig.is_on:
            WayBack(rig).walk()
        time.sleep(LOOK_S)
    raise MissedError("no edge came")


MOMENTS = (
    Moment(code="behind-edge", what="within 30 ms behind an edge of the beam", strike=_behind_edge, share=24),
    Moment(code="around-edge", what="within 30 ms of when an edge is due", strike=_around_edge, share=10),
    Moment(code="gating", what="while the gate goes on and off", strike=_beam, share=12),
    Moment(code="stopping", what="while the session is stopped and its files made", strike=_stopping, share=12),
    Moment(code="recovering", what="while a start puts the kill before in order", strike=_recovering, share=10),
    Moment(code="arming", what="around an arming", strike=_arming, share=8),
    Moment(code="measuring", what="while a session measures, not armed", strike=_measuring, share=4),
    Moment(code="session-starts", what="while a session starts", strike=_session_starts, share=5),
    Moment(code="starting", what="while the service starts", strike=_starting, share=4),
    Moment(code="backing-up", what="while a backup is made beside a session", strike=_backing_up, share=2),
    Moment(code="creating", what="while a session is made", strike=_creating, share=3),
    Moment(code="logging-in", what="while people log in and are made", strike=_logging_in, share=2),
    Moment(code="idle", what="while nothing goes on", strike=_idle, share=2),
    Moment(code="first-start", what="while the tables are made", strike=_first_start, share=2, is_fresh=True),
)


def moment_of(number: int, seed: int, code: str | None = None) -> Moment:
    """Say which moment a campaign's kill is done at: a hundred in a row have every moment's share, in mixed order."""
    if code is not None:
        return next(moment for moment in MOMENTS if moment.code == code)
    deck = [moment for moment in MOMENTS for _ in range(moment.share)]
    random.Random(f"{seed} {number // len(deck)}").shuffle(deck)
    return deck[number % len(deck)]
