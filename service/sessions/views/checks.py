"""What the gate rests on: each check of the measurement, for people."""

from engine.control import LiveView
from engine.core.clock import US_PER_S
from engine.gating import SEES_TOO_LITTLE, Check, CheckState
from service.core.schemas.live_messages import LiveCheck

WORKS = {
    Check.SURFACE: "the surface is compared with breathing",
    Check.COLOR: "the colour of the region is compared",
    Check.CAMERA: "couch and floor are compared",
}
MARKERS = ("the markers' positions are compared", "the markers' positions are not compared")
CLOCK = ("the age of the pictures is known", "the age of the pictures is not known")
PLAYED = "a recording: the age of its pictures means nothing"


def live_checks(view: LiveView) -> list[LiveCheck]:
    """Return the state of each check; empty without a reference."""
    if not view.checks:
        return []
    now_us, is_live = view.record.measurement.timestamp_us, view.description.is_live
    return [
        *(_live_check(state, now_us) for state in view.checks),
        LiveCheck(
            name="markers",
            state="off" if view.movement is None else "on",
            seconds=None,
            text=MARKERS[view.movement is None],
        ),
        LiveCheck(
            name="clock",
            state="on" if view.is_clock_checked else "off" if is_live else "never",
            seconds=None,
            text=CLOCK[not view.is_clock_checked] if is_live else PLAYED,
        ),
    ]


def _live_check(state: CheckState, now_us: int) -> LiveCheck:
    name = "on" if state.is_on else "off" if state.was_on else "never"
    return LiveCheck(
        name=state.check.value,
        state=name,
        seconds=max(now_us - state.since_us, 0) / US_PER_S,
        text=WORKS[state.check] if state.is_on else SEES_TOO_LITTLE[state.check],
    )
