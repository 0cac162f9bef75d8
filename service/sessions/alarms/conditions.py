"""What of the newest view is an alarm: conditions by code, each with its detail. Pure."""

from collections.abc import Iterable

from engine.control import LiveView
from engine.core.gate_state import GateState, HoldReason
from service.core.alarm_table import ALARMS, AUDIT_TROUBLE, PERMIT_WITHOUT_BEAM, THREAD_ENDED, AlarmScope

UNKNOWN = HoldReason.UNKNOWN.value
BEAM_WITHOUT_PERMIT = HoldReason.BEAM_WITHOUT_PERMIT.value


def gate_conditions(view: LiveView) -> dict[str, str]:
    """Return what stands as an alarm in a view: the latched fault, a hold of an armed gate, and the beam itself.

    A beam without a permit is an alarm whatever else the gate is latched for, and disarmed too.
    """
    found: dict[str, str] = {}
    reason = view.record.hold_reason
    if view.record.gate_state is GateState.FAULT:
        found[fault_code(reason)] = view.detail
    elif reason is not None and view.is_armed and _is_alarm(reason.value, AlarmScope.ARMED):
        found[reason.value] = view.detail
    beam_on = view.beam_on
    if beam_on is not None and beam_on.violation is not None:
        found[BEAM_WITHOUT_PERMIT] = beam_on.violation
    if beam_on is not None and beam_on.is_absent and view.is_armed:
        found[PERMIT_WITHOUT_BEAM] = ""
    return found


def site_conditions(audit_troubles: Iterable[str], ended_threads: Iterable[str]) -> dict[str, str]:
    """Return the service's own conditions while a session runs."""
    found = {AUDIT_TROUBLE: "; ".join(audit_troubles), THREAD_ENDED: ", ".join(ended_threads)}
    return {code: detail for code, detail in found.items() if detail}


def fault_code(reason: HoldReason | None) -> str:
    """Return the alarm of a latched fault: a reason that has none is an unknown one, and the most urgent."""
    return reason.value if reason is not None and _is_alarm(reason.value, AlarmScope.FAULT) else UNKNOWN


def _is_alarm(code: str, scope: AlarmScope) -> bool:
    rule = ALARMS.get(code)
    return rule is not None and rule.scope is scope
