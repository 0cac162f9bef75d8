"""What people and machines ask of the engine of the session that runs, and what is written down of it.

What takes permission away is done first and written down after, by connections that no read has; what could lead to a
permit is written down first, and not done when it cannot be.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace

from engine.commands import Acknowledge, Arm, Command, Disarm, HoldBeam, ReleaseBeam, SetReference
from engine.errors import CommandRefusedError
from engine.mailbox import MAX_WAIT_NS
from service.arrival import asked_ns
from service.audit import Event
from service.audit_log import AuditLog
from service.db import repository
from service.db.engine import Database
from service.errors import EngineTimeoutError, SessionStateError
from service.ports import CommandName, RunningEngine
from service.room import Room, Running
from service.withdrawals import Withdrawals

COMMANDS: dict[CommandName, Callable[[str], Command]] = {
    "arm": lambda operator: Arm(operator=operator),
    "disarm": lambda operator: Disarm(operator=operator),
    "reference": lambda operator: SetReference(operator=operator),
    "acknowledge": lambda operator: Acknowledge(operator=operator),
    "hold": lambda operator: HoldBeam(operator=operator),
    "release": lambda operator: ReleaseBeam(operator=operator),
}
AGES_FROM_ARRIVAL = (Arm, ReleaseBeam, SetReference, Acknowledge)
"""As old as the call that asks: what has to wait for a thread or the audit grows old there, too. What takes permission
away never grows old: it takes back all that came in before the engine is told."""
TAKES_PERMISSION_AWAY = (Disarm, HoldBeam)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asker:
    """See the module; ``undelayed`` are the audit and the database as what takes permission away has them."""

    room: Room
    log: AuditLog
    database: Database
    undelayed_log: AuditLog
    undelayed_database: Database
    answer_timeout_s: float
    withdrawals: Withdrawals = field(default_factory=Withdrawals)

    def ask(
        self,
        session_id: str,
        command: Command,
        operator: str,
        action: str,
        detail: dict[str, object] | None = None,
        *,
        after: Callable[[RunningEngine], dict[str, object]] | None = None,
        may_be_done: Callable[[], None] = lambda: None,
    ) -> None:
        """Put a command to the engine and write down who asked, before and after; ``after`` finds what came of it."""
        done = Event(actor=operator, action=action, session_id=session_id, detail=detail or {})
        is_undelayed = takes_permission_away(command) and self.room.of(session_id) is not None
        log = self.undelayed_log if is_undelayed else self.log
        with log.refusals(actor=operator, action=action, session_id=session_id, detail=detail):
            running = self.running(session_id, self.undelayed_database if is_undelayed else None)
            if not takes_permission_away(command):
                _refuse_late(command)
                log.write(replace(done, outcome="requested"))
            with _unless_refused(may_be_done):
                self._await(running, command)
        found = {} if after is None else after(running.engine)
        log.write(replace(done, detail={**done.detail, **found}))

    def running(self, session_id: str, by: Database | None = None) -> Running:
        """Return the session as it runs; raise SessionStateError where it does not, and NotFoundError.

        ``by`` are other connections, where it may be that all of these are taken.
        """
        running = self.room.of(session_id)
        if running is None:
            with (by or self.database).read() as db:
                raise state_error(repository.session_row(db, session_id).status, "running")
        return running

    def _await(self, running: Running, command: Command) -> None:
        with self.withdrawals.one(running.plan.session_id) if takes_permission_away(command) else nullcontext():
            self._submit(running, command)

    def _submit(self, running: Running, command: Command) -> None:
        asked = asked_ns() if isinstance(command, AGES_FROM_ARRIVAL) else None
        future = running.engine.submit(command, submitted_ns=asked)
        try:
            future.result(self.answer_timeout_s)
        except (FutureTimeoutError, CancelledError) as error:
            future.cancel()  # an arm that comes too late must not surprise anyone
            msg = f"the engine did not answer within {self.answer_timeout_s:g} s"
            raise EngineTimeoutError(msg) from error


def takes_permission_away(command: Command) -> bool:
    """Whether it can only hold the beam."""
    return isinstance(command, TAKES_PERMISSION_AWAY)


def state_error(status: str, bound: str) -> SessionStateError:
    """Say that a session is not as it has to be."""
    msg = f"the session is {status}: it must be {bound}"
    return SessionStateError(msg, field="status", value=status, bound=bound)


@contextmanager
def _unless_refused(may_be_done: Callable[[], None]) -> Iterator[None]:
    """Call, unless the engine refused: what was not answered in time may be done all the same."""
    try:
        yield
    except CommandRefusedError:
        raise
    except BaseException:
        may_be_done()
        raise
    may_be_done()


def _refuse_late(command: Command) -> None:
    """Refuse what waited so long for its turn that whoever asked may have gone."""
    if isinstance(command, AGES_FROM_ARRIVAL) and time.monotonic_ns() - asked_ns() > MAX_WAIT_NS:
        msg = "the service was busy for too long: look, and ask again"
        raise CommandRefusedError(msg)
