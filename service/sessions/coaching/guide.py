"""One frame for the patient screen, as pure functions: level, band and instruction on a scale from 0 to 1.

Guided is the window's first signal, by the first condition on it that has edges. The stage of a breath hold is the
gate's own, so that the screen never says "hold" where the gate does not count a hold; a frame that the gate does not
trust is not shown.
"""

from dataclasses import dataclass
from typing import NamedTuple

from engine.control import LiveView
from engine.core.breath import SignalChoice
from engine.core.gate_state import Guidance, HoldReason
from engine.core.signals import LearnedRange
from engine.gating import AmplitudeWindow, BreathHoldWindow, ConditionState, HoldKind, HoldStage, Unit, initial_states
from service.core.schemas.base import rounded_or_none
from service.core.schemas.coaching import Coaching, Instruction, PercentRange

US_PER_S = 1e6
DIGITS = 3
MARGIN = 0.15
"""Free part of the displayed scale beyond breath and band, at each end."""
AFTERWARDS: dict[HoldKind, Instruction] = {HoldKind.INSPIRATION: "breathe_out", HoldKind.EXPIRATION: "breathe_in"}
FOLLOWED = frozenset({None, *(reason for reason in HoldReason if reason.row.guide is Guidance.FOLLOWED)})
"""Reasons for a hold with which the frame is trusted and the patient's breath decides."""
FREE = frozenset(reason for reason in HoldReason if reason.row.guide is Guidance.FREE)
"""Reasons with which the frame is trusted, but no breath of the patient would bring the beam."""


class Span(NamedTuple):
    """An interval of the guided signal [mm, l of the volume], or of the displayed scale."""

    lower: float
    upper: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Guided:
    """The condition that the patient is guided by; ``hold`` is None for one without a breath hold."""

    choice: SignalChoice
    edges: Span | None
    hold: BreathHoldWindow | None = None
    state: ConditionState | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideFrame:
    """What the screen draws of a frame; places are from 0 to 1 of the displayed scale."""

    level: float | None
    band: Span | None
    instruction: Instruction
    countdown_s: float | None


NOT_MEASURED = GuideFrame(level=None, band=None, instruction="none", countdown_s=None)


def guided_by(view: LiveView) -> Guided:
    """Return what guides: a breath hold on the first signal before an amplitude on it; else the signal alone."""
    leaves = view.window.leaves
    states = view.conditions if len(view.conditions) == len(leaves) else initial_states(view.window)
    choice = view.window.choices[0]
    on_signal = [(leaf, state) for leaf, state in zip(leaves, states, strict=True) if leaf.choices[0] == choice]
    for leaf, state in on_signal:
        if isinstance(leaf, BreathHoldWindow):
            return Guided(choice=choice, edges=edges_of(leaf.level), hold=leaf, state=state)
    for leaf, _ in on_signal:
        if isinstance(leaf, AmplitudeWindow):
            return Guided(choice=choice, edges=edges_of(leaf))
    return Guided(choice=choice, edges=None)


def edges_of(window: AmplitudeWindow) -> Span | None:
    """Return the edges in the unit of the signal; None while they are in per cent of a range that is not known."""
    return None if window.unit is Unit.PERCENT else Span(window.lower, window.upper)


def guide_frame(view: LiveView, learned: LearnedRange | None, settings: Coaching, *, is_resting: bool) -> GuideFrame:
    """Return the guidance of a frame; without a level where the frame was not measured, or nothing gives a scale."""
    motion = view.record.measurement.as_gated.motion
    if view.record.hold_reason not in FOLLOWED | FREE:
        return NOT_MEASURED
    guided = guided_by(view)
    band = band_of(guided, learned, settings)
    scale = scale_of(band, learned, settings)
    level = None if motion is None else rounded_or_none(guided.choice.value_in(motion), 6)
    if level is None or scale is None:
        return NOT_MEASURED
    return GuideFrame(
        level=_place(level, scale),
        band=None if band is None else Span(_place(band.lower, scale), _place(band.upper, scale)),
        instruction=_instruction(view, guided, level, band, settings, is_resting=is_resting),
        countdown_s=_countdown_s(view, guided),
    )


def band_of(guided: Guided, learned: LearnedRange | None, settings: Coaching) -> Span | None:
    """Return the comfort band in the signal's unit: the therapist's, in a breath hold never beyond the window."""
    chosen = None if settings.band is None or learned is None else span_of(settings.band, learned)
    if chosen is None or guided.edges is None or guided.hold is None:
        return chosen or guided.edges
    inside = Span(max(chosen.lower, guided.edges.lower), min(chosen.upper, guided.edges.upper))
    return inside if inside.lower < inside.upper else guided.edges


def scale_of(band: Span | None, learned: LearnedRange | None, settings: Coaching) -> Span | None:
    """Return what the screen's height shows: the therapist's scale, or breath and band with a margin."""
    if settings.scale is not None and learned is not None:
        return span_of(settings.scale, learned)
    shown = [span for span in (band, None if learned is None else Span(learned.low, learned.high)) if span is not None]
    if not shown:
        return None
    lower, upper = min(span.lower for span in shown), max(span.upper for span in shown)
    beyond = MARGIN * (upper - lower) if learned is not None else upper - lower
    return Span(lower - beyond, upper + beyond)


def span_of(part: PercentRange, learned: LearnedRange) -> Span:
    """Convert per cent of the learned range to the signal's unit."""
    reach = 0.01 * (learned.high - learned.low)
    return Span(learned.low + part.lower_percent * reach, learned.low + part.upper_percent * reach)


def _place(value: float, scale: Span) -> float:
    share = (value - scale.lower) / (scale.upper - scale.lower)
    return round(min(max(share, 0.0), 1.0), DIGITS)


def _instruction(
    view: LiveView, guided: Guided, level: float, band: Span | None, settings: Coaching, *, is_resting: bool
) -> Instruction:
    if view.record.hold_reason in FREE or view.operator_hold is not None or is_resting or band is None:
        return "breathe_freely"
    if guided.hold is not None and guided.state is not None:
        return _hold_instruction(guided.hold, guided.state.stage, level, band)
    # Window edges are no advice on how to breathe: most breaths are meant to leave an amplitude window.
    return "breathe_freely" if settings.band is None else _towards(level, band) or "breathe_freely"


def _hold_instruction(hold: BreathHoldWindow, stage: HoldStage, level: float, band: Span) -> Instruction:
    match stage:
        case HoldStage.HELD:
            return "hold"
        case HoldStage.SETTLING:
            return _towards(level, band) or "hold"
        case HoldStage.DRIFTED | HoldStage.OVER:
            return AFTERWARDS[HoldKind(hold.kind)]
    # In the band, and the gate counts no hold: nothing that the patient does would help.
    return _towards(level, _entered(band, hold.level.hysteresis)) or "breathe_freely"


def _entered(band: Span, hysteresis: float) -> Span:
    """Return the part of the band in which the gate has surely noticed the entry."""
    inner = Span(band.lower + hysteresis, band.upper - hysteresis)
    return inner if inner.lower < inner.upper else band


def _towards(level: float, band: Span) -> Instruction | None:
    """Return the way to the band; None inside."""
    if level < band.lower:
        return "breathe_in"
    return "breathe_out" if level > band.upper else None


def _countdown_s(view: LiveView, guided: Guided) -> float | None:
    """Return the rest of a hold that has settled, by the gate's own time limit [s]."""
    state = guided.state
    if guided.hold is None or state is None or state.settled_at is None:
        return None
    if state.stage not in {HoldStage.SETTLING, HoldStage.HELD}:
        return None
    elapsed_s = (view.record.measurement.timestamp_us - state.held_since_us) / US_PER_S
    return round(min(max(guided.hold.timeout_s - elapsed_s, 0.0), guided.hold.timeout_s), 2)
