"""A session's window within the site's limits: it may narrow them, never widen them."""

from engine.limits import GateLimits
from engine.windows import amplitude_window
from service import schemas
from service.errors import BoundError
from service.settings import Settings


def check_window(window: schemas.Window, settings: Settings) -> None:
    """Refuse a window wider than the site allows; raise BoundError."""
    _at_least("window.lower_mm", window.lower_mm, settings.window_lower_mm)
    _at_least("window.dwell_ms", window.dwell_ms, settings.min_dwell_ms)
    if window.upper_mm > settings.window_upper_mm:
        bound = f"at most {settings.window_upper_mm:g}, this site's limit"
        msg = f"window.upper_mm must be {bound}"
        raise BoundError(msg, field="window.upper_mm", value=window.upper_mm, bound=bound)


def gate_limits(window: schemas.Window, settings: Settings) -> GateLimits:
    """Put the session's window and the site's limits into the engine's words; raise InvalidValueError."""
    return GateLimits(
        window=amplitude_window(**window.model_dump(exclude={"dwell_ms"})),
        dwell_ms=window.dwell_ms,
        min_on_ms=settings.min_on_ms,
        min_off_ms=settings.min_off_ms,
        max_cycles_per_min=settings.max_cycles_per_min,
        holding_events=frozenset(settings.holding_events),
        **settings.gate_limits,
    )


def _at_least(field: str, value: float, low: float) -> None:
    if value < low:
        bound = f"at least {low:g}, this site's limit"
        msg = f"{field} must be {bound}"
        raise BoundError(msg, field=field, value=value, bound=bound)
