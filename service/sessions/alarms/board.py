"""The active alarms, and the events that made them: an alarm begins, is acknowledged, and ends.

Thread-safe; nothing here waits for more than the board's own lock, and nothing reads a clock: the caller passes times.
What of the newest view is an alarm, and how alarms are shown, are pure functions.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum

from engine.control import LiveView
from engine.core.clock import NS_PER_S
from engine.core.gate_state import GateState, HoldReason
from service.core.alarm_table import ALARMS, AUDIT_TROUBLE, PERMIT_WITHOUT_BEAM, THREAD_ENDED, AlarmRule, AlarmScope
from service.core.schemas.live_messages import LiveAlarm, LiveAlarmEvent
from service.core.schemas.sentences import sentence_parts

CLEAR_NS = NS_PER_S
"""A condition that is absent for less than this counts as lasting, so that a flickering one is one alarm."""
KEPT_EVENTS = 4096
UNKNOWN = HoldReason.UNKNOWN.value
BEAM_WITHOUT_PERMIT = HoldReason.BEAM_WITHOUT_PERMIT.value


class AlarmEventKind(StrEnum):
    """What happened to an alarm."""

    BEGIN = "begin"
    ACKNOWLEDGED = "acknowledged"
    END = "end"


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """One occurrence of an alarm.

    Attributes
    ----------
    number
        Number of the occurrence, rising over the life of the process.
    detail
        Details with values, as at the beginning.
    since
        When the condition began, before the alarm's delay.
    """

    number: int
    session_id: str
    rule: AlarmRule
    detail: str
    since: datetime
    acknowledged_by: str | None = None
    acknowledged_at: datetime | None = None

    @property
    def urgency(self) -> tuple[int, bool, int]:
        """Sorts the most urgent first: by priority, those not acknowledged before the others, then by age."""
        return (self.rule.priority.rank, self.acknowledged_by is not None, self.number)


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmEvent:
    """A change of one alarm; ``active`` are all alarms after it, the most urgent first."""

    number: int
    kind: AlarmEventKind
    at: datetime
    alarm: Alarm
    active: tuple[Alarm, ...]


@dataclass(slots=True)
class _Seen:
    """A condition: since when it has lasted, and when it was present last [ns, monotonic]."""

    since_ns: int
    last_ns: int
    detail: str


class AlarmBoard:
    """All active alarms of one session; a latched one of an earlier session stays until the next session begins.

    Parameters
    ----------
    utc_of
        Converts host monotonic time [ns] to UTC.
    """

    def __init__(self, utc_of: Callable[[int], datetime]) -> None:
        self._utc_of = utc_of
        self._lock = threading.Lock()
        self._session_id: str | None = None
        self._is_over = False
        self._seen: dict[str, _Seen] = {}
        self._alarms: dict[str, Alarm] = {}
        self._events: deque[AlarmEvent] = deque(maxlen=KEPT_EVENTS)
        self._event_number = self._alarm_number = 0
        self._active: tuple[Alarm, ...] = ()

    @property
    def active(self) -> tuple[Alarm, ...]:
        """The active alarms, the most urgent first; the same object while nothing changes."""
        return self._active

    @property
    def newest_event(self) -> int:
        """Number of the newest event; 0 before the first."""
        return self._event_number

    def active_of(self, session_id: str) -> tuple[Alarm, ...]:
        """Return the active alarms of one session, the most urgent first."""
        return tuple(alarm for alarm in self._active if alarm.session_id == session_id)

    def events_after(self, number: int) -> list[AlarmEvent]:
        """Return the events after the one with this number, oldest first, as far back as they are kept."""
        if number >= self._event_number:
            return []
        with self._lock:
            return [event for event in self._events if event.number > number]

    def update(self, session_id: str, conditions: Mapping[str, str], now_ns: int) -> None:
        """Begin and end alarms by the present conditions: details by code. Ignored for a session that is over."""
        with self._lock:
            if session_id != self._session_id:
                self._begin_session(session_id, now_ns)
            if self._is_over:
                return
            self._note(conditions, now_ns)
            self._begin_due(conditions, now_ns)
            self._end_gone(now_ns)

    def end_session(self, session_id: str, now_ns: int) -> None:
        """End the alarms of a session that is over; a latched one stays until it is acknowledged."""
        with self._lock:
            if session_id != self._session_id:
                return
            self._is_over = True
            self._seen.clear()
            self._end_gone(now_ns)

    def acknowledge(self, session_id: str, numbers: Iterable[int], operator: str, now_ns: int) -> None:
        """Acknowledge alarms by a named person; the first one who does stays named. A latched alarm ends with it."""
        with self._lock:
            for number in numbers:
                alarm = next((one for one in self._alarms.values() if one.number == number), None)
                if alarm is not None and alarm.session_id == session_id and alarm.acknowledged_by is None:
                    self._acknowledge(alarm, operator, now_ns)

    def _begin_session(self, session_id: str, now_ns: int) -> None:
        for code in tuple(self._alarms):
            self._end(code, now_ns)
        self._seen.clear()
        self._session_id, self._is_over = session_id, False

    def _note(self, conditions: Mapping[str, str], now_ns: int) -> None:
        for code, detail in conditions.items():
            seen = self._seen.setdefault(code, _Seen(now_ns, now_ns, detail))
            seen.last_ns = now_ns
        for code, seen in tuple(self._seen.items()):
            # A fault is cleared by a person; its absence needs no second look.
            if code not in conditions and (ALARMS[code].latches or now_ns - seen.last_ns >= CLEAR_NS):
                del self._seen[code]

    def _begin_due(self, conditions: Mapping[str, str], now_ns: int) -> None:
        for code in conditions:
            rule, seen = ALARMS[code], self._seen[code]
            if code not in self._alarms and now_ns - seen.since_ns >= rule.delay_s * NS_PER_S:
                self._alarm_number += 1
                alarm = Alarm(
                    number=self._alarm_number,
                    session_id=self._session_id or "",
                    rule=rule,
                    detail=seen.detail,
                    since=self._utc_of(seen.since_ns),
                )
                self._alarms[code] = alarm
                self._emit(AlarmEventKind.BEGIN, alarm, now_ns)

    def _end_gone(self, now_ns: int) -> None:
        for code, alarm in tuple(self._alarms.items()):
            if code not in self._seen and not alarm.rule.latches:
                self._end(code, now_ns)

    def _acknowledge(self, alarm: Alarm, operator: str, now_ns: int) -> None:
        code = alarm.rule.code
        known = replace(alarm, acknowledged_by=operator, acknowledged_at=self._utc_of(now_ns))
        self._alarms[code] = known
        self._emit(AlarmEventKind.ACKNOWLEDGED, known, now_ns)
        if alarm.rule.latches:  # a cause that persists begins another one, not seen yet
            self._seen.pop(code, None)
            self._end(code, now_ns)

    def _end(self, code: str, now_ns: int) -> None:
        self._emit(AlarmEventKind.END, self._alarms.pop(code), now_ns)

    def _emit(self, kind: AlarmEventKind, alarm: Alarm, now_ns: int) -> None:
        self._active = tuple(sorted(self._alarms.values(), key=lambda one: one.urgency))
        event = AlarmEvent(
            number=self._event_number + 1, kind=kind, at=self._utc_of(now_ns), alarm=alarm, active=self._active
        )
        self._events.append(event)
        self._event_number = event.number


def live_alarm(alarm: Alarm) -> LiveAlarm:
    """Return one alarm."""
    rule = alarm.rule
    return LiveAlarm(
        number=alarm.number,
        session_id=alarm.session_id,
        code=rule.code,
        priority=rule.priority.value,
        text=rule.text,
        detail=alarm.detail,
        sentences=sentence_parts(alarm.detail),
        since=alarm.since,
        latches=rule.latches,
        acknowledged_by=alarm.acknowledged_by,
        acknowledged_at=alarm.acknowledged_at,
    )


def live_alarms(alarms: Iterable[Alarm]) -> list[LiveAlarm]:
    """Return alarms in their order."""
    return [live_alarm(alarm) for alarm in alarms]


def live_alarm_event(event: AlarmEvent) -> LiveAlarmEvent:
    """Return a change of an alarm."""
    return LiveAlarmEvent(number=event.number, kind=event.kind.value, at=event.at, alarm=live_alarm(event.alarm))


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
