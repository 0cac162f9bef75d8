"""Alarms as the live stream and the session resource show them. Pure."""

from collections.abc import Iterable

from service.core.schemas.live_messages import LiveAlarm, LiveAlarmEvent
from service.sessions.alarms.board import Alarm, AlarmEvent


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
