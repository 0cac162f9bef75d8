"""The interlocks of this site: the engine's table with the displayed texts and the site's settings."""

from engine.gating.interlock_table import INTERLOCKS
from engine.gating.interlock_table import Interlock as Row
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
        return InterlockList(items=[self._interlock(row) for row in INTERLOCKS])

    def _interlock(self, row: Row) -> Interlock:
        return Interlock(
            code=row.code.value,
            text=HOLD_TEXTS[row.code],
            trips=row.trips,
            latches=row.is_fault,
            settings=[self._setting(name) for name in row.settings],
            source=row.source,
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
