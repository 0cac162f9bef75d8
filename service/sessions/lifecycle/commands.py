"""Commands of operators to the engine of the running session, each with its rows in the audit.

A command that takes permission away is executed first and audited afterwards, over database connections reserved for
it. A command that may lead to a permit is audited first, and not executed when the audit cannot be written.

A named person acknowledges the latched fault and the alarms: one call for both.

The gate's fault is acknowledged by the engine, which may refuse; only then are the alarms. An alarm that begins after
the request came is not acknowledged with it: no person has seen it.
"""

import time
from collections.abc import Callable, Collection
from concurrent.futures import CancelledError, TimeoutError as FutureTimeoutError
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

from engine.control import MAX_WAIT_NS, Command
from engine.core.commands import Acknowledge, Arm, Countersign, Disarm, HoldBeam, ReleaseBeam, SetReference
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState
from engine.gating import SetWindow
from service.core.current_request import request_time_ns
from service.core.errors import EngineTimeoutError, SessionStateError
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import CommandName, RunningEngine, RunningSession
from service.sessions.alarms.board import Alarm, fault_code
from service.sessions.alarms.watch import AlarmWatch
from service.sessions.records.etags import Withdrawals
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import Database

COMMANDS: dict[CommandName, Callable[[str, bool], Command]] = {
    "disarm": lambda operator, _: Disarm(operator=operator),
    "hold": lambda operator, is_person: HoldBeam(operator=operator, is_person=is_person),
}
AGES_FROM_ARRIVAL = (Arm, ReleaseBeam, SetReference, SetWindow, Acknowledge, Countersign)
"""Their age counts from the arrival of the request: waiting for a thread or the audit makes them older, too. A command
that takes permission away has no age: it revokes everything that was submitted before it."""
TAKES_PERMISSION_AWAY = (Disarm, HoldBeam)
ACTION = "session.acknowledge"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EngineCommander:
    """Submits commands to the running engine and audits them.

    Attributes
    ----------
    priority_log, priority_database
        Connections reserved for commands that take permission away: hold, disarm, and stop.
    answer_timeout_s
        How long the engine may take to execute a command [s].
    withdrawals
        Counts the commands that take permission away, for the sessions' ETags.
    """

    equipment: EquipmentSlot
    log: AuditLog
    database: Database
    priority_log: AuditLog
    priority_database: Database
    answer_timeout_s: float
    withdrawals: Withdrawals = field(default_factory=Withdrawals)

    def execute(
        self,
        session_id: str,
        command: Command,
        operator: str,
        action: str,
        detail: dict[str, object] | None = None,
        *,
        after: Callable[[RunningEngine], dict[str, object]] | None = None,
    ) -> None:
        """Submit a command, wait for its result, and audit both as ``action`` with ``detail``.

        ``after`` returns what the audit records of the result.

        Raises
        ------
        CommandRefusedError
            The engine refused, or the request waited too long before it was submitted.
        EngineTimeoutError
            The engine did not answer in time; the command is cancelled unless it takes permission away.
        SessionStateError
            The session does not run.
        """
        done = Event(actor=operator, action=action, session_id=session_id, detail=detail or {})
        has_priority = takes_permission_away(command) and self.equipment.of(session_id) is not None
        log = self.priority_log if has_priority else self.log
        with log.refusals(actor=operator, action=action, session_id=session_id, detail=detail):
            running = self.running(session_id, self.priority_database if has_priority else None)
            if not takes_permission_away(command):
                _refuse_late(command)
                log.write(replace(done, outcome="requested"))
            self._await(running, command)
        found = {} if after is None else after(running.engine)
        log.write(replace(done, detail={**done.detail, **found}))

    def running(self, session_id: str, by: Database | None = None) -> RunningSession:
        """Return the running session; raise SessionStateError if it does not run, NotFoundError if it does not exist.

        ``by`` is the database to look in, where the ordinary connections may all be in use.
        """
        running = self.equipment.of(session_id)
        if running is None:
            with (by or self.database).read() as db:
                raise state_error(queries.session_row(db, session_id).status, "running")
        return running

    def _await(self, running: RunningSession, command: Command) -> None:
        with self.withdrawals.one(running.plan.session_id) if takes_permission_away(command) else nullcontext():
            self._submit(running, command)

    def _submit(self, running: RunningSession, command: Command) -> None:
        submitted_ns = request_time_ns() if isinstance(command, AGES_FROM_ARRIVAL) else None
        future = running.engine.submit(command, submitted_ns=submitted_ns)
        try:
            future.result(self.answer_timeout_s)
        except (FutureTimeoutError, CancelledError) as error:
            future.cancel()  # it must not arm after its caller was answered with an error
            msg = f"the engine did not answer within {self.answer_timeout_s:g} s"
            raise EngineTimeoutError(msg) from error


def takes_permission_away(command: Command) -> bool:
    """Whether a command can only hold the beam or disarm the gate, never lead to a permit."""
    return isinstance(command, TAKES_PERMISSION_AWAY)


def state_error(status: str, bound: str) -> SessionStateError:
    """Return the error for a session in another state than a call needs."""
    msg = f"the session is {status}: it must be {bound}"
    return SessionStateError(msg, field="status", value=status, bound=bound)


def _refuse_late(command: Command) -> None:
    """Refuse a command whose request waited so long in the service that the operator may have left."""
    if isinstance(command, AGES_FROM_ARRIVAL) and time.monotonic_ns() - request_time_ns() > MAX_WAIT_NS:
        msg = "the service was busy for too long: check the session, then try again"
        raise CommandRefusedError(msg)


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
