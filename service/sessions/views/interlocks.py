"""The interlocks of this site: the engine's table with the displayed texts and the site's settings."""

from engine.core.gate_state import INTERLOCKS, HoldReason
from service.core.hold_texts import HOLD_TEXTS
from service.core.schemas.gate import Interlock, InterlockList, InterlockSetting
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings


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
