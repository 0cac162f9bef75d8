"""Looks at the running session for alarms, in a thread of its own, and writes their events to the audit, in another.

Neither is in the gate's way: the gate holds by itself, and an alarm only says so. The look reads memory alone, so that
a database that hangs delays no alarm.
"""

import logging
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from engine.core.clock import NS_PER_US, Clock, MonotonicClock
from service.core.periodic import PeriodicWorker
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import RunningSession
from service.sessions.alarms.board import (
    Alarm,
    AlarmBoard,
    AlarmEvent,
    AlarmEventKind,
    gate_conditions,
    site_conditions,
)
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.database.engine import Database
from service.storage.database.queries import RetriedWriter

logger = logging.getLogger(__name__)

LOOK_S = 0.05
WRITE_S = 0.1
STOP_S = 2.0
ACTIONS = {
    AlarmEventKind.BEGIN: "alarm.begin",
    AlarmEventKind.ACKNOWLEDGED: "alarm.acknowledge",
    AlarmEventKind.END: "alarm.end",
}


def utc_now() -> datetime:
    """Return the wall clock's time."""
    return datetime.now(UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteTroubles:
    """Reads the service's own conditions, from memory."""

    audit: Callable[[], Iterable[str]] = tuple
    ended_threads: Callable[[], Iterable[str]] = tuple


class AlarmWatch:
    """Feeds the board from the running session's newest view.

    Parameters
    ----------
    clock
        Host monotonic time of the alarms' delays.
    """

    def __init__(
        self,
        equipment: EquipmentSlot,
        database: Database,
        *,
        clock: Clock | None = None,
        now: Callable[[], datetime] = utc_now,
    ) -> None:
        self._equipment, self._clock, self._now = equipment, clock or MonotonicClock(), now
        self._lock = threading.Lock()
        self.troubles = SiteTroubles()
        self.board = AlarmBoard(self._utc)
        self._recorder = AlarmRecorder(self.board, database)
        self._workers = (
            PeriodicWorker("tidegate-alarms", self.look, interval_s=LOOK_S),
            PeriodicWorker(
                "tidegate-alarm-audit",
                self._recorder.write,
                interval_s=WRITE_S,
                last=self._recorder.write,
                recoverable=(SQLAlchemyError,),
            ),
        )

    @property
    def has_ended(self) -> bool:
        """Whether one of the threads has ended without `close`."""
        return any(worker.has_ended for worker in self._workers)

    def start(self) -> None:
        """Start looking."""
        for worker in self._workers:
            worker.start()

    def close(self) -> None:
        """Stop looking, and write the last events."""
        for worker in self._workers:
            worker.stop(STOP_S)

    def look(self) -> None:
        """Update the board by the newest view; called by the thread, and around an acknowledgement."""
        with self._lock:
            running = self._equipment.running
            if running is not None:
                self._look_at(running)

    def session_over(self, running: RunningSession) -> None:
        """Look a last time at a session whose engine is over, and end its alarms that do not latch."""
        with self._lock:
            self._look_at(running)
            self.board.end_session(running.plan.session_id, self._clock.now_ns())

    def acknowledge(self, session_id: str, seen: Iterable[Alarm], operator: str) -> None:
        """Acknowledge the alarms that the operator has seen."""
        numbers = [alarm.number for alarm in seen]
        self.board.acknowledge(session_id, numbers, operator, self._clock.now_ns())
        self.look()

    def _look_at(self, running: RunningSession) -> None:
        view = running.engine.status.view
        if view is None:
            return
        found = gate_conditions(view) | site_conditions(self.troubles.audit(), self.troubles.ended_threads())
        self.board.update(running.plan.session_id, found, self._clock.now_ns())

    def _utc(self, monotonic_ns: int) -> datetime:
        return self._now() - timedelta(microseconds=(self._clock.now_ns() - monotonic_ns) / NS_PER_US)


class AlarmRecorder:
    """Writes the board's events to the audit, in order; owned by one thread. A write that fails is repeated."""

    def __init__(self, board: AlarmBoard, database: Database) -> None:
        self._board = board
        self._writer = RetriedWriter(database)
        self._batch: list[AlarmEvent] = []
        self._written = 0

    def write(self) -> None:
        """Commit the events since the last call; raise SQLAlchemyError where the database fails."""
        self._batch = self._batch or self._board.events_after(self._written)
        if not self._batch:
            return
        missed = self._batch[0].number - self._written - 1
        if missed:
            logger.critical("%d alarm events were not recorded: the database failed for too long", missed)
        self._writer.write(self._batch, self._append)
        self._written = self._batch[-1].number
        self._batch = []

    def _append(self, db: Session) -> None:
        for event in self._batch:
            audit.append(db, alarm_event(event), event.at)


def alarm_event(event: AlarmEvent) -> Event:
    """Return the audit event of a change of an alarm."""
    alarm = event.alarm
    actor = alarm.acknowledged_by if event.kind is AlarmEventKind.ACKNOWLEDGED else None
    return Event(
        actor=actor or SYSTEM,
        action=ACTIONS[event.kind],
        session_id=alarm.session_id,
        detail={
            "alarm": alarm.number,
            "code": alarm.rule.code,
            "priority": alarm.rule.priority.value,
            "text": alarm.rule.text,
            "detail": alarm.detail,
            "since": alarm.since.isoformat(),
            "acknowledged_by": alarm.acknowledged_by,
        },
    )
