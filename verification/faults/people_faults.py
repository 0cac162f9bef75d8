"""What people do with the beam on: hold, disarm, stop, change the zero or the model, walk away."""

import random
import time
from typing import TYPE_CHECKING

from verification.faults.kinds import ARMED, BY_ITSELF, NEW_SESSION, PERSON_MS, Fault, FaultKind, Inject, reported
from verification.faults.plan import WATCHED
from verification.faults.verdict import Recovery

if TYPE_CHECKING:
    from verification.faults.rig import Rig

FAMILY = "people"
PERSON = "a person's order over HTTP: 100 ms"
PAGE_MS = 3000.0


def ordered(action: str, **more: object) -> Inject:
    """Ask for something of the session; counted from before the call."""

    def inject(rig: "Rig", _random: random.Random) -> Fault:
        cause_ns = time.monotonic_ns()
        answer = rig.person.act(action, **more)
        assert answer.status_code < 300, answer.text
        return Fault(cause_ns=cause_ns)

    return inject


def activated(rig: "Rig", _random: random.Random) -> Fault:
    """Take up the model once more that the session measures with."""
    model_id = rig.person.models()[0]["id"]
    cause_ns = time.monotonic_ns()
    answer = rig.person.post(f"/models/{model_id}/activate")
    assert answer.status_code < 300, answer.text
    return Fault(cause_ns=cause_ns)


def page_closed(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.person.leave_page(), undo=rig.person.come_back, lasts_s=0.2)


def _kind(code: str, what: str, inject: Inject, reason: str, recoveries: frozenset[Recovery], **more: object):
    wanted = {"bound": PERSON, "bound_ms": PERSON_MS, **more}
    return FaultKind(
        code=code, what=what, family=FAMILY, inject=inject, reported=reported(reason), recoveries=recoveries, **wanted
    )


KINDS = (
    _kind("held-by-hand", "a person holds the beam", ordered("hold"), "operator_hold", frozenset({Recovery.RELEASED})),
    _kind("disarmed", "a person disarms", ordered("disarm"), "disarmed", ARMED),
    _kind("session-stopped", "a person stops the session", ordered("stop"), "engine_stopped", NEW_SESSION),
    _kind(
        "zero-set",
        "a person sets the reference again",
        ordered("reference", at="now", reason="lies otherwise"),
        "disarmed",
        ARMED,
    ),
    _kind("model-activated", "a person takes up a stored model", activated, "disarmed", ARMED),
    _kind(
        *("operator-lost", "the page of the person who armed falls silent", page_closed, "operator_lost", BY_ITSELF),
        plan=WATCHED,
        bound="the page's 3 s, then 100 ms",
        bound_ms=PAGE_MS + PERSON_MS,
    ),
)
