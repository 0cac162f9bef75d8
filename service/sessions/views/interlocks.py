"""The interlocks of this site: the engine's table with the displayed texts and the site's settings.

What the gate rests on: each check of the measurement, for people.
"""

from engine.control import LiveView
from engine.core.clock import US_PER_S
from engine.core.gate_state import INTERLOCKS, HoldReason
from engine.core.sentences import say
from engine.gating import SEES_TOO_LITTLE, Check, CheckState
from service.core.alarm_table import HOLD_TEXTS
from service.core.schemas.gate import Interlock, InterlockList, InterlockSetting
from service.core.schemas.live_messages import LiveCheck
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings

WORKS = {
    Check.SURFACE: say("the surface is compared with breathing"),
    Check.COLOR: say("the colour of the region is compared"),
    Check.CAMERA: say("couch and floor are compared"),
    Check.MARKERS: say("the markers' positions are compared"),
}
CLOCK = (say("the age of the pictures is known"), say("the age of the pictures is not known"))
PLAYED = say("a recording: the age of its pictures means nothing")


class InterlockTable:
    """Lists the interlocks of a site."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def interlocks(self) -> InterlockList:
        """List them, in the engine's order."""
        return InterlockList(items=[self._interlock(reason) for reason in INTERLOCKS])

    def _interlock(self, reason: HoldReason) -> Interlock:
        return Interlock(
            code=reason.value,
            text=HOLD_TEXTS[reason],
            trips=reason.row.trips,
            latches=reason.is_fault,
            settings=[self._setting(name) for name in reason.row.settings],
            source=reason.row.source,
        )

    def _setting(self, name: str) -> InterlockSetting:
        value = getattr(self._settings, name)
        return InterlockSetting(
            name=name,
            variable=setting_name(name),
            value=[str(one) for one in value] if isinstance(value, tuple) else value,
            low=_bound(name, "ge"),
            high=_bound(name, "le"),
        )


def _bound(name: str, kind: str) -> float | None:
    """Return a setting's declared lower (``ge``) or upper (``le``) bound."""
    found = (getattr(one, kind, None) for one in Settings.model_fields[name].metadata)
    return next((float(one) for one in found if one is not None), None)


def live_checks(view: LiveView) -> list[LiveCheck]:
    """Return the state of each check; empty without a reference."""
    if not view.checks:
        return []
    now_us, is_live = view.record.measurement.timestamp_us, view.description.is_live
    return [
        *(_live_check(state, now_us) for state in view.checks),
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
