"""A named person acknowledges the latched fault and the alarms: one call for both.

The gate's fault is acknowledged by the engine, which may refuse; only then are the alarms. An alarm that begins after
the request came is not acknowledged with it: nobody has seen it.
"""

from collections.abc import Collection
from dataclasses import dataclass

from engine.core.commands import Acknowledge
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState
from service.engine_host.equipment import EquipmentSlot
from service.sessions.alarms.board import Alarm
from service.sessions.alarms.conditions import fault_code
from service.sessions.alarms.watch import AlarmWatch
from service.sessions.lifecycle.commands import EngineCommander
from service.storage.audit import Event

ACTION = "session.acknowledge"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Acknowledgement:
    """Acknowledges faults and alarms, and audits who did."""

    alarms: AlarmWatch
    equipment: EquipmentSlot
    commander: EngineCommander

    def acknowledge(self, session_id: str, operator: str, wanted: Collection[int] | None) -> None:
        """Acknowledge the alarms with the numbers ``wanted``, or everything that is active now.

        Raises
        ------
        CommandRefusedError
            There is nothing to acknowledge, or the engine refused.
        SessionStateError
            The session does not run, and left no alarm.
        """
        self.alarms.look()  # a fault of this instant is seen with the others
        active = self.alarms.board.active_of(session_id)
        seen = [alarm for alarm in active if wanted is None or alarm.number in wanted]
        is_new = any(alarm.acknowledged_by is None for alarm in seen)
        detail: dict[str, object] = {"alarms": [alarm.number for alarm in seen]}
        if self._is_of_gate(session_id, seen) or (wanted is None and not is_new):
            self.commander.execute(session_id, Acknowledge(operator=operator), operator, ACTION, detail)
        else:
            log = self.commander.log
            with log.refusals(actor=operator, action=ACTION, session_id=session_id, detail=detail):
                self._refuse_unless(session_id, is_new=is_new)
            log.write(Event(actor=operator, action=ACTION, session_id=session_id, detail=detail))
        self.alarms.acknowledge(session_id, seen, operator)

    def _is_of_gate(self, session_id: str, seen: Collection[Alarm]) -> bool:
        """Whether the fault that the gate has latched is one of the alarms."""
        view = self.equipment.view(session_id)
        if view is None or view.record.gate_state is not GateState.FAULT:
            return False
        code = fault_code(view.record.hold_reason)
        return any(alarm.rule.code == code for alarm in seen)

    def _refuse_unless(self, session_id: str, *, is_new: bool) -> None:
        if not is_new:
            self.commander.running(session_id)  # of an unknown or closed session, this is the better answer
            raise CommandRefusedError("none of these alarms is active and not yet acknowledged: look again")
