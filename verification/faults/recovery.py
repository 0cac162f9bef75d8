"""What a person does until the beam is on: restarts, makes a session, sets the zero, acknowledges, releases, arms."""

import contextlib
import time
from typing import TYPE_CHECKING, Any

import httpx2

from verification.faults.operator import PATIENCE_S, PersonGaveUpError
from verification.faults.verdict import Recovery

if TYPE_CHECKING:
    from verification.faults.rig import Rig

HEAVIEST_FIRST = (
    *(Recovery.RESTARTED, Recovery.NEW_SESSION, Recovery.ACKNOWLEDGED, Recovery.ARMED, Recovery.RELEASED),
    Recovery.BY_ITSELF,
)
STEP_S = 0.02
STOP_AFTER_S = 25.0
"""Who asks in vain for so long stops the session, and makes another; at once where the refusal says it is in vain."""

DOUBTED_S = 4.0
"""A surface that moved as no skin can is doubted until a person sets the zero: who looks on for so long does that."""

DOUBTED = ("residual_high", "jump", "surface_changed", "patient_shifted", "baseline_drifted")
PERSISTS = 25
"""A fault that is there again though it was acknowledged so often is not one that goes."""

IN_VAIN = ("has died", "does not run")


class WayBack:
    """One way back to the beam on.

    Attributes
    ----------
    asked_ns, acted_ns
        When the beam was first asked for, and when anything was first done; None where no one had to.
    refusal
        The newest answer to an arming.
    """

    def __init__(self, rig: "Rig") -> None:
        self._rig, self._person = rig, rig.person
        self.asked_ns: int | None = None
        self.acted_ns: int | None = None
        self.refusal = ""
        self._stop_at_s = time.monotonic() + STOP_AFTER_S
        self._trusted_s = time.monotonic()
        self._acknowledged = 0

    def walk(self) -> Recovery | None:
        """Go on until the receiver says on; return the heaviest thing that was needed, None if it never came on."""
        done = {Recovery.BY_ITSELF}
        end_s = time.monotonic() + PATIENCE_S
        while not self._rig.is_on:
            if time.monotonic() > end_s:
                return None
            with contextlib.suppress(PersonGaveUpError, OSError, httpx2.HTTPError):
                step = self._step()
                done |= {step} if step is not None else set()
            time.sleep(STEP_S)
        return next(one for one in HEAVIEST_FIRST if one in done)

    def _step(self) -> Recovery | None:
        if not self._rig.is_alive:
            self._rig.start_service()
            return Recovery.RESTARTED
        detail = self._person.detail() if self._person.session_id else None
        if detail is not None and detail["status"] == "running" and self._is_in_vain:
            self._act("stop")
            return None
        if detail is None or detail["status"] != "running":
            self._rig.new_session()
            self.refusal = ""
            self._acknowledged = 0
            self._stop_at_s = time.monotonic() + STOP_AFTER_S
            return Recovery.NEW_SESSION
        return None if detail["gate"] is None else self._act_on(detail)

    @property
    def _is_in_vain(self) -> bool:
        is_hopeless = any(words in self.refusal for words in IN_VAIN)
        return is_hopeless or time.monotonic() > self._stop_at_s or self._acknowledged > PERSISTS

    def _act_on(self, detail: dict[str, Any]) -> Recovery | None:
        gate = detail["gate"]
        if gate["state"] == "fault":
            self._act("acknowledge")
            self._acknowledged += 1
            return Recovery.ACKNOWLEDGED
        if gate["operator_hold"] is not None:
            return self._ask("release", Recovery.RELEASED)
        if self._is_doubted(gate) or not (detail["has_reference"] or detail["measurement_state"] != "measuring"):
            self._act("reference", at="now", reason="lies otherwise")
            return None
        if gate["is_armed"] or detail["measurement_state"] != "measuring":
            return None
        return self._ask("arm", Recovery.ARMED)

    def _act(self, action: str, **more: object) -> httpx2.Response:
        self.acted_ns = self.acted_ns or time.monotonic_ns()
        return self._person.act(action, **more)

    def _is_doubted(self, gate: dict[str, Any]) -> bool:
        if gate["hold_reason"] not in DOUBTED:
            self._trusted_s = time.monotonic()
        return time.monotonic() - self._trusted_s > DOUBTED_S

    def _ask(self, action: str, step: Recovery) -> Recovery | None:
        self.asked_ns = self.asked_ns or time.monotonic_ns()
        answer = self._act(action)
        self.refusal = answer.text
        return step if answer.status_code == httpx2.codes.OK else None
