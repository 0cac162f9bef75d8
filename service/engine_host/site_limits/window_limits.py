"""A session's window, regions and head direction within the site's limits: it may narrow them, never widen them.

Edges in per cent refer to a range that is not learned yet: they are checked against the site's edges when they are
converted to mm, at arming (`engine.control.gate_controller`). The site's edges are mm. A phase and a volume bound no
position: where the site has set its edges, every way into the beam needs a condition on a length beside them.

The head direction fits the room, and the plan's Patient Position. A patient lies along the couch, with the head towards
the gantry (head first) or away from it (feet first). DICOM's Patient Position (0018,5100) says which, and on which side
of the body the patient lies; only supine patients are measured, because the markers are ordered for a body that is seen
from its front.
"""

from dataclasses import replace
from typing import TypeVar

from engine.core.breath import LITRES_PER_MM, SignalChoice
from engine.core.signals import HeadDirection
from engine.gating import GateLimits, GateWindow, JoinedWindow
from engine.motion import NamedRegion, PipelineSettings
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.schemas.windows import Condition, Window
from service.core.settings.names import PREFIX
from service.core.settings.settings import Settings

NO_REGIONS = sessions.Regions()
NumberT = TypeVar("NumberT", int, float)
FIELD = "head_direction"
GANTRY_SIDE = f"{PREFIX}GANTRY_SIDE"
HEAD_FIRST_SUPINE, FEET_FIRST_SUPINE = "HFS", "FFS"
SUPPORTED_POSITIONS = (HEAD_FIRST_SUPINE, FEET_FIRST_SUPINE)


def check_window(window: Window, settings: Settings) -> None:
    """Refuse a window wider than the site allows; raise BoundError."""
    for path, condition in window.conditions():
        _check_condition(path, condition, settings)
    _refuse_way_around(window, settings)
    _at_least("window.dwell_ms", window.dwell_ms, settings.min_dwell_ms)
    if window.min_on_ms is not None:
        _at_least("window.min_on_ms", window.min_on_ms, settings.min_on_ms)
    if window.min_off_ms is not None:
        _at_least("window.min_off_ms", window.min_off_ms, settings.min_off_ms)
    if window.max_cycles_per_min is not None:
        _at_most("window.max_cycles_per_min", window.max_cycles_per_min, settings.max_cycles_per_min)


def gate_limits(
    window: Window,
    settings: Settings,
    regions: sessions.Regions = NO_REGIONS,
    *,
    is_calibrated: bool = True,
    head_direction: HeadDirection | None = None,
    camera_latency_ms: float | None = None,
) -> GateLimits:
    """Convert the session's window and the site's limits to the engine's gate limits.

    ``camera_latency_ms`` is that of the session's camera; None for the site's value, which it never undercuts.

    Raises
    ------
    InvalidValueError
        The engine has no such window.
    BoundError
        A condition refers to a named region that the session does not have.
    """
    return GateLimits(
        window=gate_window(window, regions),
        dwell_ms=window.dwell_ms,
        min_on_ms=_or(window.min_on_ms, settings.min_on_ms),
        min_off_ms=_or(window.min_off_ms, settings.min_off_ms),
        max_cycles_per_min=_or(window.max_cycles_per_min, settings.max_cycles_per_min),
        holding_events=frozenset(settings.holding_events),
        is_calibrated=is_calibrated or settings.beam_without_calibration,
        head_direction=head_direction,
        needs_all_checks=not settings.checks_may_be_missing,
        needs_countersignature=settings.needs_countersignature,
        **settings.gate_limits | {"camera_latency_ms": max(settings.camera_latency_ms, camera_latency_ms or 0.0)},
    )


def gate_window(window: Window, regions: sessions.Regions = NO_REGIONS) -> GateWindow:
    """Convert to the engine's window; points and named regions become their index among the measured ones."""
    made = tuple(
        condition.to_engine(_index_of(path, condition, window, regions)) for path, condition in window.conditions()
    )
    return made[0] if len(made) == 1 else JoinedWindow(conditions=made, join=window.join)


def breath_signals(window: Window, regions: sessions.Regions = NO_REGIONS) -> tuple[SignalChoice, ...]:
    """Return the signals whose breath is followed: the first condition's, and those gated by all but inspiration."""
    return tuple(
        dict.fromkeys(
            condition.choice(_index_of(path, condition, window, regions))
            for path, condition in window.conditions()
            if condition is window or condition.kind in {"amplitude", "phase"} or condition.hold == "expiration"
        )
    )


def _check_condition(path: str, condition: Condition, settings: Settings) -> None:
    if condition.lower_mm is not None:
        _at_least(f"{path}.lower_mm", condition.lower_mm, settings.window_lower_mm)
    if condition.upper_mm is not None:
        _at_most(f"{path}.upper_mm", condition.upper_mm, settings.window_upper_mm)
    if condition.timeout_s is not None:
        _at_most(f"{path}.timeout_s", condition.timeout_s, settings.max_breath_hold_s)
    _check_hold(path, condition, settings)
    if condition.min_confidence is not None:
        _at_least(f"{path}.min_confidence", condition.min_confidence, settings.min_phase_confidence)


def _check_hold(path: str, condition: Condition, settings: Settings) -> None:
    """Refuse a breath hold that need not be held: its numbers excuse it from rules of free breathing."""
    for unit, per_mm in (("mm", 1.0), ("l", LITRES_PER_MM)):
        for name, most_mm in (("still", settings.max_hold_still_mm), ("max_drift", settings.max_hold_drift_mm)):
            value = getattr(condition, f"{name}_{unit}")
            if value is not None:
                _at_most(f"{path}.{name}_{unit}", value, most_mm * per_mm)
    if condition.settle_ms is not None:
        _at_least(f"{path}.settle_ms", condition.settle_ms, settings.min_hold_settle_ms)


def _refuse_way_around(window: Window, settings: Settings) -> None:
    """Refuse a window that may be met wherever the patient is, where the site has said where that may be."""
    unbound = [(path, condition) for path, condition in window.conditions() if not _bounds_position(condition)]
    is_way_around = window.join == "or" or len(unbound) == 1 + len(window.further)
    if not settings.bounds_position or not unbound or not is_way_around:
        return
    path, condition = unbound[0]
    name = "kind" if condition.kind == "phase" else "signal"
    what = "a phase" if condition.kind == "phase" else "a volume"
    site = f"{settings.window_lower_mm:g} to {settings.window_upper_mm:g} mm"
    bound = (
        f"on a length, amplitude or breath_hold, or joined by and with one that is: the beam may be on at {site}, "
        f"this site's limit, and {what} bounds no position"
    )
    raise _broken(f"{path}.{name}", getattr(condition, name), bound)


def _bounds_position(condition: Condition) -> bool:
    return condition.kind != "phase" and condition.signal != "volume"


def _index_of(path: str, condition: Condition, window: Window, regions: sessions.Regions) -> int:
    if condition.row is not None and condition.column is not None and condition.signal == "point":
        return window.points.index((condition.row, condition.column))
    if condition.name is None:
        return 0
    names = [region.name for region in regions.named]
    if condition.name not in names:
        bound = f"one of the session's own regions: {', '.join(names) or 'there is none'}"
        raise _broken(f"{path}.name", condition.name, bound)
    return names.index(condition.name)


def _or(given: NumberT | None, otherwise: NumberT) -> NumberT:
    return otherwise if given is None else given


def _at_least(field: str, value: float, low: float) -> None:
    if value < low:
        raise _broken(field, value, f"at least {low:g}, this site's limit")


def _at_most(field: str, value: float, high: float) -> None:
    if value > high:
        raise _broken(field, value, f"at most {high:g}, this site's limit")


def _broken(field: str, value: object, bound: str) -> BoundError:
    return BoundError(f"{field} must be {bound}", field=field, value=value, bound=bound)


def measuring_with(
    settings: PipelineSettings,
    regions: sessions.Regions,
    window: Window | None = None,
    head_direction: HeadDirection | None = None,
) -> PipelineSettings:
    """Return how the pipeline measures a session: with its regions and head, and the points and breaths of its window.

    Without a head direction the pipeline assumes one: the whole region and its volume do not depend on it.
    """
    named = tuple(
        NamedRegion(name=region.name, vertices=tuple((row, column) for row, column in region.vertices))
        for region in regions.named
    )
    line = regions.split
    split = settings.split if line is None else (line.right_row, line.left_row)
    return replace(
        settings,
        named=named,
        split=split,
        points=settings.points if window is None else tuple(dict.fromkeys((*window.points, *settings.points))),
        breath_signals=settings.breath_signals if window is None else breath_signals(window, regions),
        superior_px=settings.superior_px if head_direction is None else head_direction.superior_px,
        extra_markers=regions.extra_markers or settings.extra_markers,
    )


def check_head_direction(head: HeadDirection | None, settings: Settings) -> None:
    """Refuse a patient who would lie across the couch; raise BoundError."""
    gantry = settings.gantry_side
    if head is None or gantry is None or head in {gantry, gantry.opposite}:
        return
    bound = f"{gantry} (head first) or {gantry.opposite} (feet first): the gantry is at the {gantry} ({GANTRY_SIDE})"
    raise BoundError(f"{FIELD} must be {bound}", field=FIELD, value=head.value, bound=bound)


def head_of(position: str | None, gantry: HeadDirection | None) -> HeadDirection | None:
    """Return where the head of a patient in this position lies; None if position or room are unknown."""
    if position is None or gantry is None:
        return None
    return gantry if position == HEAD_FIRST_SUPINE else gantry.opposite
