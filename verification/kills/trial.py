"""One kill: a rig brought to its moment, killed, started again, and all that it left looked at."""

import contextlib
import random
import time
from dataclasses import dataclass

import httpx2

from engine.core.clock import NS_PER_S
from service.storage import audit
from service.storage.database.engine import Database
from service.storage.samples.store import SampleStore
from verification.faults.kinds import MissedError
from verification.faults.operator import PersonGaveUpError
from verification.faults.rig import DATABASE
from verification.kills.moments import Moment, Strike, kill
from verification.kills.rig import KillRig
from verification.kills.verdict import (
    Evidence,
    Outcome,
    Step,
    Trouble,
    edge_ms,
    is_last_instant,
    judge,
    lost_ms,
    off_ms,
)

STAYS_OFF_S = 0.35
TRIES = 4
PAGE = 200
READY_S = 20.0
"""A start answers before its engine's process stands by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Killed:
    """A kill, and what it left."""

    strike: Strike
    evidence: Evidence
    restart_s: float


def run_trial(rig: KillRig, moment: Moment, number: int, seed: int) -> Outcome:
    """Kill once, everything random following from number and seed; again where the moment was missed."""
    began_s = time.monotonic()
    missed: list[str] = []
    while len(missed) < TRIES:
        chance = random.Random(f"{moment.code} {number} {seed} {len(missed)}")
        try:
            killed = _kill_once(rig, moment, chance)
        except MissedError as error:
            missed.append(str(error))
            _put_right(rig)
            continue
        return _outcome(killed, moment, number, seconds=time.monotonic() - began_s)
    return Outcome(number=number, moment=moment.code, troubles=(Trouble.NO_RESULT,), note="; ".join(missed))


def _kill_once(rig: KillRig, moment: Moment, chance: random.Random) -> Killed:
    edges_before = len(rig.edges)
    rig.person.session_id = ""
    strike = moment.strike(rig, chance)
    time.sleep(STAYS_OFF_S)
    began_s = time.monotonic()
    rig.start_service()
    restart_s = time.monotonic() - began_s
    evidence = _fresh(rig, strike) if moment.is_fresh else _look(rig, strike, edges_before)
    return Killed(strike=strike, evidence=evidence, restart_s=restart_s)


def _look(rig: KillRig, strike: Strike, edges_before: int) -> Evidence:
    session_id = rig.person.session_id if strike.has_session else ""
    before = [edge.at_ns for edge in rig.edges[edges_before:] if edge.at_ns <= strike.killed_ns]
    off = [edge.at_ns for edge in rig.edges[edges_before:] if not edge.is_on and edge.at_ns >= strike.killed_ns]
    return Evidence(
        killed_ns=strike.killed_ns,
        steps=_steps(rig, session_id) if session_id else (),
        measured_from_ns=strike.measured_from_ns,
        last_sample_ns=_last_sample_ns(rig, session_id) if session_id else None,
        status=_status(rig, session_id),
        is_audit_intact=rig.person.is_chain_intact(),
        database_trouble=rig.database_trouble,
        leftovers=rig.leftovers,
        is_ready=_is_ready(rig),
        has_new_session=_has_new_session(rig),
        edges=rig.edges[edges_before:],  # last: an on that comes while we look is seen
        stall_before_ms=rig.watchman.stalled_ms(max(before, default=strike.killed_ns), strike.killed_ns),
        stall_ms=rig.watchman.stalled_ms(strike.killed_ns, min(off, default=strike.killed_ns + NS_PER_S)),
    )


def _is_ready(rig: KillRig) -> bool:
    end_s = time.monotonic() + READY_S
    while time.monotonic() < end_s:
        if rig.person.get_top("/readyz").status_code == httpx2.codes.OK:
            return True
        time.sleep(0.1)
    return False


def _fresh(rig: KillRig, strike: Strike) -> Evidence:
    """Look at a data folder in which no one can log in yet; then go back to the one before."""
    database = Database(rig.data / DATABASE)
    with database.read() as db:
        is_intact = audit.verify(db).first_broken_sequence is None
    database.close()
    evidence = Evidence(
        killed_ns=strike.killed_ns,
        is_audit_intact=is_intact,
        database_trouble=rig.database_trouble,
        leftovers=rig.leftovers,
    )
    _put_right(rig)
    return evidence


def _put_right(rig: KillRig) -> None:
    """Have a service that runs, on the data folder of the campaign, with no session open."""
    kill(rig)
    rig.refill_data()
    rig.start_service()
    rig.close_open_sessions()


def _steps(rig: KillRig, session_id: str) -> tuple[Step, ...]:
    found: list[Step] = []
    cursor = ""
    while True:
        page = rig.person.get(f"/sessions/{session_id}/transitions?limit={PAGE}{cursor}").json()
        found += [
            Step(
                from_state=item["from_state"],
                to_state=item["to_state"],
                reason=item["reason"] or "",
                decided_ns=item["decided_ns"],
                number=item["number"],
                received_ns=item["received_ns"],
                is_recovered=item["recovered"],
            )
            for item in page["items"]
        ]
        if page["next_cursor"] is None:
            return tuple(found)
        cursor = f"&cursor={page['next_cursor']}"


def _last_sample_ns(rig: KillRig, session_id: str) -> int | None:
    newest = None
    for batch in SampleStore(rig.data / "samples").batches(session_id):
        times = batch["received_ns"]
        newest = times[len(times) - 1].as_py() if len(times) else newest
    return newest


def _status(rig: KillRig, session_id: str) -> str:
    """Return the session's status; of any other that is said to run still, that."""
    items = rig.person.get("/sessions").json()["items"]
    if any(item["status"] == "running" for item in items):
        return "running"
    return next((str(item["status"]) for item in items if item["id"] == session_id), "")


def _has_new_session(rig: KillRig) -> bool:
    with contextlib.suppress(PersonGaveUpError):
        rig.close_open_sessions()
        rig.person.create_session(rig.session_body)
        return rig.person.act("stop").status_code == httpx2.codes.OK
    return False


def _outcome(killed: Killed, moment: Moment, number: int, *, seconds: float) -> Outcome:
    evidence = killed.evidence
    troubles = judge(evidence)
    return Outcome(
        number=number,
        moment=moment.code,
        troubles=troubles,
        off_ms=off_ms(evidence),
        lost_ms=lost_ms(evidence),
        edge_ms=edge_ms(evidence),
        steps=len(evidence.steps),
        recovered=sum(step.is_recovered for step in evidence.steps),
        is_last_instant=is_last_instant(evidence),
        restart_s=round(killed.restart_s, 2),
        seconds=round(seconds, 1),
        note=_note(evidence) if troubles else "",
    )


def _note(evidence: Evidence) -> str:
    def at(at_ns: int) -> str:
        return f"{(at_ns - evidence.killed_ns) / NS_PER_S:+.3f}"

    edges = " ".join(f"{'on' if edge.is_on else 'off'}@{at(edge.at_ns)}" for edge in evidence.edges[-8:])
    steps = " ".join(
        f"{step.number}:{step.from_state}>{step.to_state}{'*' if step.is_recovered else ''}@{at(step.decided_ns)}"
        for step in evidence.steps[-10:]
    )
    last = "none" if evidence.last_sample_ns is None else at(evidence.last_sample_ns)
    left = f" left {', '.join(evidence.leftovers)}" if evidence.leftovers else ""
    return f"line {edges} gate {steps} last sample {last} {evidence.status} {evidence.database_trouble}{left}"
