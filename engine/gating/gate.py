"""Decide whether the beam may be on: a pure reducer over one transition table.

Every event is first classified as one of a few kinds, with a reason; the table then gives the next state for that
kind and the present state. HOLD is the default: a pair that is not in the table leads to HOLD for an armed gate, and
leaves a disarmed gate disarmed and a fault latched. Only frames lead to ``BEAM_ON``, only through ``DWELL``, and only
by a full dwell of frames that were each good, fresh, next in order and inside the window.

Times are host monotonic nanoseconds and are arguments: nothing here reads a clock.
"""

from dataclasses import dataclass

from engine.core.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from engine.core.commands import Acknowledge, Arm, Disarm, ReleaseBeam
from engine.core.frames import Measurement
from engine.core.gate_state import GateState, HoldReason, Lease
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.gating.beam_on_limit import OUTSIDE, Stay, allowed_on_s
from engine.gating.delivery import Delivery
from engine.gating.frame_checks import (
    EventKind,
    LastFrame,
    Verdict,
    check_frame,
    delivery_with,
    fault,
    last_frame,
    refuse_irregular,
    refuse_rate,
    unusable,
)
from engine.gating.limits import GateLimits, ns_from_ms
from engine.gating.windows import (
    ConditionState,
    WindowInput,
    WindowVerdict,
    armed_again,
    begun,
    breathed_from_ns,
    followed,
    initial_states,
    interrupted,
    is_held,
    left,
    permitted,
)
from engine.gating.windows.patient_breath import SignalNow

CYCLES_WITHIN_NS = 60 * NS_PER_S

_S, _K = GateState, EventKind

TRANSITIONS: dict[tuple[GateState, EventKind], GateState] = {
    (_S.DISARMED, _K.ARM): _S.HOLD,
    (_S.DISARMED, _K.FAILURE): _S.FAULT,
    (_S.HOLD, _K.INSIDE): _S.DWELL,
    (_S.HOLD, _K.FAILURE): _S.FAULT,
    (_S.HOLD, _K.DISARM): _S.DISARMED,
    (_S.HOLD, _K.END): _S.DISARMED,
    (_S.DWELL, _K.INSIDE): _S.DWELL,
    (_S.DWELL, _K.DWELT): _S.BEAM_ON,
    (_S.DWELL, _K.FAILURE): _S.FAULT,
    (_S.DWELL, _K.DISARM): _S.DISARMED,
    (_S.DWELL, _K.END): _S.DISARMED,
    (_S.BEAM_ON, _K.DWELT): _S.BEAM_ON,
    (_S.BEAM_ON, _K.FAILURE): _S.FAULT,
    (_S.BEAM_ON, _K.DISARM): _S.DISARMED,
    (_S.BEAM_ON, _K.END): _S.DISARMED,
    (_S.FAULT, _K.ACKNOWLEDGE): _S.DISARMED,
}
"""All transitions; for every other pair see :func:`next_state`."""
_Seen = tuple[WindowInput, tuple[SignalNow, ...]]
_KIND_OF_COMMAND: dict[type, EventKind] = {
    Arm: EventKind.ARM,
    Disarm: EventKind.DISARM,
    Acknowledge: EventKind.ACKNOWLEDGE,
    ReleaseBeam: EventKind.UNUSABLE,  # the beam needs a full dwell
}


def next_state(state: GateState, kind: EventKind) -> GateState:
    """Return the next state: by the table, else HOLD; a disarmed or faulted gate stays as it is."""
    stays = state in {GateState.DISARMED, GateState.FAULT}
    return TRANSITIONS.get((state, kind), state if stays else GateState.HOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Silence:
    """No frame came in time. ``since_ns`` is when reading began, for a source that never delivered."""

    since_ns: int


@dataclass(frozen=True, slots=True)
class Interruption:
    """Something other than a frame forbids the beam; a fault latches, the rest clears with the next good frames."""

    reason: HoldReason
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Ending:
    """The regular end of the frames: the end of a recording, or a stop command."""

    reason: HoldReason
    detail: str = ""


GateEvent = Measurement | Silence | Interruption | Ending | Arm | Disarm | Acknowledge | ReleaseBeam


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """The complete state of the gate.

    Attributes
    ----------
    reason
        Why the beam is held; None if and only if the state is ``BEAM_ON``.
    since_ns
        When this state and reason began.
    good_frames, inside_since_ns, inside_since_us
        The run of good frames that the dwell counts: its length, and when its first frame was received [ns] and
        captured [us]. 0 and None outside of ``DWELL`` and ``BEAM_ON``.
    conditions
        State of each condition of the window; empty before the first frame.
    turned_on_ns
        Times of beam on within the last minute, the newest last.
    off_since_ns
        When the beam last went off; None before that.
    was_cut_short
        Whether the last beam on was shorter than ``min_on_ms``.
    stay
        Beam-on time since the patient last breathed, whatever window was in force.
    armed_by
        Who lets the gate decide: the operator who armed, or the person who released a hold since; None while disarmed.
    is_armed_by_program
        Whether that is a program with a key, not a person.
    """

    state: GateState = GateState.DISARMED
    reason: HoldReason | None = HoldReason.DISARMED
    detail: str = ""
    since_ns: int = 0
    good_frames: int = 0
    inside_since_ns: int | None = None
    inside_since_us: int | None = None
    last: LastFrame | None = None
    conditions: tuple[ConditionState, ...] = ()
    turned_on_ns: tuple[int, ...] = ()
    off_since_ns: int | None = None
    was_cut_short: bool = False
    stay: Stay = OUTSIDE
    armed_by: str | None = None
    is_armed_by_program: bool = False

    @property
    def is_armed(self) -> bool:
        """Whether the gate may permit the beam."""
        return self.state in {GateState.HOLD, GateState.DWELL, GateState.BEAM_ON}

    @property
    def is_inside(self) -> bool:
        """Whether a run of good frames inside the window is under way."""
        return self.state in {GateState.DWELL, GateState.BEAM_ON}

    @property
    def breath_holds(self) -> int:
        """Number of breath holds since the gate was armed."""
        return max((state.holds for state in self.conditions), default=0)


def step_gate(gate: Gate, event: GateEvent, now_ns: int, limits: GateLimits) -> Gate:
    """Return the gate after ``event``; read ``now_ns`` after the event was made."""
    if isinstance(event, Measurement):
        return _step_frame(gate, event, now_ns, limits)
    verdict = _judge(gate, event, now_ns, limits)
    moved = _count_switching(gate, _move(gate, verdict, now_ns), now_ns, limits)
    if isinstance(event, Arm):
        moved = replace(moved, conditions=armed_again(moved.conditions))
    return _name_operator(gate, moved, event)


def _step_frame(gate: Gate, frame: Measurement, now_ns: int, limits: GateLimits) -> Gate:
    delivery = delivery_with(gate.last, frame)
    seen = _seen_by_window(frame, limits)
    verdict = _judge_frame(gate, frame, delivery, seen, now_ns, limits)
    moved = _count_switching(gate, _move(gate, verdict, now_ns), now_ns, limits)
    if not moved.is_armed:
        moved = _name_operator(gate, moved, frame)
    last = last_frame(gate.last, frame, delivery, limits.window)
    return _remember(gate, _follow_stay(moved, verdict, frame, seen, now_ns, limits), frame, last)


def _seen_by_window(frame: Measurement, limits: GateLimits) -> _Seen | None:
    """Return what the window uses of a frame, sound or not, with each condition's signal; None without a motion."""
    if frame.motion is None:
        return None
    seen = WindowInput(frame.motion, frame.breaths, frame.timestamp_us, limits.breath_depths)
    signals: tuple[SignalNow, ...] = ()
    for leaf in limits.window.leaves:
        signals += (leaf.signal_now(seen),)
    return seen, signals


def _follow_stay(
    moved: Gate, verdict: Verdict, frame: Measurement, seen: _Seen | None, now_ns: int, limits: GateLimits
) -> Gate:
    """Start a new stay where the patient has breathed, and note where the signal is with the beam on."""
    stay = moved.stay if verdict.stay_from_ns is None else moved.stay.begun_at(verdict.stay_from_ns)
    stay = stay.bounded(allowed_on_s(frame.breaths, limits))
    if stay is not moved.stay:
        moved = replace(moved, stay=stay)
    if verdict.conditions is None or seen is None:
        return moved
    on_ns = moved.stay.on_ns + _on_ns(moved, now_ns, limits)
    is_on = moved.state is GateState.BEAM_ON
    conditions = permitted(seen[1], moved.conditions, on_ns=on_ns, is_on=is_on)
    return moved if conditions is moved.conditions else replace(moved, conditions=conditions)


def _name_operator(before: Gate, moved: Gate, event: GateEvent) -> Gate:
    """Name who lets the gate decide after an event; a program's release takes over from nobody."""
    if not moved.is_armed:
        return replace(moved, armed_by=None, is_armed_by_program=False)
    if isinstance(event, Arm) and not before.is_armed:
        return replace(moved, armed_by=event.operator, is_armed_by_program=not event.is_person)
    if isinstance(event, ReleaseBeam) and event.is_person:
        return replace(moved, armed_by=event.operator, is_armed_by_program=False)
    return moved


def lease_of(gate: Gate, *, decided_ns: int, sequence: int, limits: GateLimits) -> Lease | None:
    """Return the lease for a gate in ``BEAM_ON``, else None; it counts from when the newest frame was *received*."""
    if gate.state is not GateState.BEAM_ON or gate.last is None:
        return None
    expires_ns = gate.last.received_ns + limits.lease_ns
    return Lease(granted_ns=decided_ns, expires_ns=expires_ns, sequence=sequence)


def _move(gate: Gate, verdict: Verdict, now_ns: int) -> Gate:
    state = next_state(gate.state, verdict.kind)
    reason, detail = _reason_in(state, gate, verdict)
    is_same = state is gate.state and reason is gate.reason
    since_ns = gate.since_ns if is_same else now_ns
    return replace(
        gate,
        state=state,
        reason=reason,
        detail=detail,
        since_ns=since_ns,
        good_frames=0,
        inside_since_ns=None,
        inside_since_us=None,
        conditions=_conditions_in(state, gate, verdict),
    )


def _conditions_in(state: GateState, gate: Gate, verdict: Verdict) -> tuple[ConditionState, ...]:
    """Return the state of the conditions; all have to enter again where the gate as a whole is outside."""
    if verdict.conditions is None:
        return interrupted(gate.conditions)
    return verdict.conditions if state in {GateState.DWELL, GateState.BEAM_ON} else left(verdict.conditions)


def _count_switching(before: Gate, moved: Gate, now_ns: int, limits: GateLimits) -> Gate:
    """Note when the beam went on and off: the next on may have to wait."""
    was_on, is_on = before.state is GateState.BEAM_ON, moved.state is GateState.BEAM_ON
    if is_on and not was_on:
        recent = tuple(at_ns for at_ns in before.turned_on_ns if now_ns - at_ns < CYCLES_WITHIN_NS)
        return replace(moved, turned_on_ns=(*recent, now_ns))
    if is_on or not was_on:
        return moved
    on_ns = now_ns - before.turned_on_ns[-1]
    stay = before.stay._replace(on_ns=before.stay.on_ns + _on_ns(before, now_ns, limits))
    return replace(moved, off_since_ns=now_ns, was_cut_short=on_ns < ns_from_ms(limits.min_on_ms), stay=stay)


def _on_ns(gate: Gate, now_ns: int, limits: GateLimits) -> int:
    """Return for how long the beam is on by now; it goes off with the newest frame's lease, whatever comes."""
    if gate.state is not GateState.BEAM_ON or gate.last is None:
        return 0
    return min(now_ns, gate.last.received_ns + limits.lease_ns) - gate.turned_on_ns[-1]


def _reason_in(state: GateState, gate: Gate, verdict: Verdict) -> tuple[HoldReason | None, str]:
    if state is GateState.BEAM_ON:
        return None, ""
    if state is GateState.FAULT and gate.state is GateState.FAULT:
        return gate.reason, gate.detail  # the first cause stays until it is acknowledged
    if state is GateState.DISARMED:
        is_end = verdict.kind is EventKind.END
        return (verdict.reason, verdict.detail) if is_end else (HoldReason.DISARMED, "")
    return verdict.reason or HoldReason.DWELL, verdict.detail


def _remember(before: Gate, moved: Gate, frame: Measurement, last: LastFrame) -> Gate:
    """Count the run of good frames, and store what the next frame is compared with."""
    if not moved.is_inside:
        return replace(moved, last=last)
    if before.inside_since_ns is None or before.inside_since_us is None:
        since_ns, since_us, frames = frame.received_ns, frame.timestamp_us, 1
    else:
        since_ns, since_us, frames = before.inside_since_ns, before.inside_since_us, before.good_frames + 1
    return replace(moved, last=last, good_frames=frames, inside_since_ns=since_ns, inside_since_us=since_us)


def _judge(gate: Gate, event: object, now_ns: int, limits: GateLimits) -> Verdict:
    match event:
        case Silence():
            return _judge_silence(gate, event, now_ns, limits)
        case Interruption():
            kind = EventKind.FAILURE if event.reason.is_fault else EventKind.UNUSABLE
            return Verdict(kind, event.reason, event.detail)
        case Ending():
            return Verdict(EventKind.END, event.reason, event.detail)
    kind_of_command = _KIND_OF_COMMAND.get(type(event))
    if kind_of_command is None:
        return fault(HoldReason.UNKNOWN, say("{name} is no event of the gate", name=type(event).__name__))
    return Verdict(
        kind_of_command,
        detail=say("released by {operator}", operator=event.operator) if isinstance(event, ReleaseBeam) else "",
    )


def _judge_silence(gate: Gate, event: Silence, now_ns: int, limits: GateLimits) -> Verdict:
    since_ns = event.since_ns if gate.last is None else gate.last.received_ns
    silent_ms = (now_ns - since_ns) / NS_PER_MS
    detail = say("no frame for {silent_ms:.0f} ms", silent_ms=silent_ms)
    if gate.last is not None and silent_ms > limits.max_silence_ms:
        return Verdict(EventKind.FAILURE, HoldReason.FRAME_TIMEOUT, detail)
    return Verdict(EventKind.UNUSABLE, HoldReason.FRAME_MISSING, detail)


def _judge_frame(
    gate: Gate, frame: Measurement, delivery: Delivery, seen: _Seen | None, now_ns: int, limits: GateLimits
) -> Verdict:
    verdict = check_frame(gate.last, frame, delivery, now_ns, limits) or _refuse_lapsed(gate, now_ns, limits)
    if verdict is not None:
        return verdict
    if seen is None:  # unreachable: a frame without motion does not pass the checks
        return fault(HoldReason.VALUE_INVALID, say("no motion"))
    return _judge_window(gate, frame, seen, now_ns, limits)


def _refuse_lapsed(gate: Gate, now_ns: int, limits: GateLimits) -> Verdict | None:
    """Hold where the lease of the line has lapsed: it is off, and a new on needs a dwell."""
    if gate.state is not GateState.BEAM_ON or gate.last is None:
        return None
    late_ns = now_ns - gate.last.received_ns - limits.lease_ns
    if late_ns < 0:
        return None
    return unusable(
        HoldReason.FRAME_LATE,
        say("decided {late_ms:.0f} ms after the line's lease had lapsed", late_ms=late_ns / NS_PER_MS),
    )


def _judge_window(gate: Gate, frame: Measurement, seen: _Seen, now_ns: int, limits: GateLimits) -> Verdict:
    window = limits.window
    states = gate.conditions if len(gate.conditions) == len(window.leaves) else initial_states(window)
    states = followed(seen[1], states, limits.max_gap_ms)
    on_ns = gate.stay.on_ns + _on_ns(gate, now_ns, limits)
    stay_from_ns = breathed_from_ns(window, states, on_ns)
    found = window.judge(seen[0], states)
    if stay_from_ns is not None:
        on_ns -= stay_from_ns
        found = found._replace(states=begun(found.states))
    verdict = _judge_inside(gate, frame, found, on_ns, now_ns, limits)
    return verdict if stay_from_ns is None else verdict._replace(stay_from_ns=stay_from_ns)


def _judge_inside(
    gate: Gate, frame: Measurement, found: WindowVerdict, on_ns: int, now_ns: int, limits: GateLimits
) -> Verdict:
    """Return the verdict of a frame inside the window or outside of it; ``on_ns`` is the beam-on time of the stay."""
    if not found.is_inside:
        return Verdict(EventKind.OUTSIDE, found.reason, found.detail, found.states)
    is_breath_held = is_held(limits.window, found.states)
    irregular = None if is_breath_held else refuse_irregular(frame, limits.holding_events) or refuse_rate(frame, limits)
    refused = irregular or _on_too_long(gate.stay, on_ns)
    if refused is not None:
        return refused._replace(conditions=interrupted(found.states))
    if not _has_dwelt(gate, frame, limits):
        return Verdict(EventKind.INSIDE, conditions=found.states)
    too_soon = None if gate.state is GateState.BEAM_ON else _too_soon(gate, now_ns, limits, found.states)
    return too_soon or Verdict(EventKind.DWELT, conditions=found.states)


def _on_too_long(stay: Stay, on_ns: int) -> Verdict | None:
    """Hold where the beam has been on for as long as is allowed in one breath."""
    allowed_ns = stay.allowed_ns
    if allowed_ns is None or on_ns < allowed_ns:
        return None
    detail = say(
        "{on_s:.0f} s of beam since the patient breathed out of the window, {allowed_s:.0f} allowed: "
        "the signal has to leave the window first",
        on_s=on_ns / NS_PER_S,
        allowed_s=allowed_ns / NS_PER_S,
    )
    return unusable(HoldReason.BEAM_ON_LIMIT, detail)


def _too_soon(gate: Gate, now_ns: int, limits: GateLimits, states: tuple[ConditionState, ...]) -> Verdict | None:
    """Return why the switching limits still forbid beam on, for a gate without beam."""
    off_ns = needed_ns = ns_from_ms(limits.min_off_ms)
    if gate.off_since_ns is not None:
        off_ns = max(now_ns - gate.off_since_ns, 0)
    if off_ns < needed_ns:
        detail = say(
            "off for {off_ms:.0f} of {min_off_ms:g} ms", off_ms=off_ns / NS_PER_MS, min_off_ms=limits.min_off_ms
        )
        return Verdict(EventKind.INSIDE, HoldReason.SHORTEST_OFF, detail, states)
    cycles = sum(now_ns - at_ns < CYCLES_WITHIN_NS for at_ns in gate.turned_on_ns)
    if cycles >= limits.max_cycles_per_min:
        detail = say(
            "{cycles} times on within a minute, {max_cycles_per_min} allowed",
            cycles=cycles,
            max_cycles_per_min=limits.max_cycles_per_min,
        )
        return Verdict(EventKind.INSIDE, HoldReason.CYCLE_LIMIT, detail, states)
    return None


def _has_dwelt(gate: Gate, frame: Measurement, limits: GateLimits) -> bool:
    if gate.inside_since_ns is None or gate.inside_since_us is None:
        return False
    dwell_ns = limits.dwell_ns_after_cut_short if gate.was_cut_short else limits.dwell_ns
    return (
        gate.good_frames + 1 >= limits.min_good_frames
        and frame.received_ns - gate.inside_since_ns >= dwell_ns
        and (frame.timestamp_us - gate.inside_since_us) * NS_PER_US >= dwell_ns
    )
