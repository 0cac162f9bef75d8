"""Check whether a measured frame may be used for a decision, independent of its amplitude.

Pure functions of the frame, the summary of earlier frames, the limits and the time of the decision; each returns a
verdict with its reason. They are separate from the gate because the faults of a frame do not depend on its state.
"""

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.breath import BreathEventKind
from engine.core.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from engine.core.frames import LostReason, Measurement, MeasurementState, Motion, SeenShares
from engine.core.gate_state import HoldReason
from engine.core.sentences import listed, say
from engine.gating.delivery import (
    MAX_RATE_ERROR_PPM,
    Delivery,
    followed_delivery,
    is_age_known,
    lag_of,
    unseen_ageing_ms,
)
from engine.gating.limits import GateLimits, ns_from_ms
from engine.gating.windows import ConditionState, GateWindow

SEEN_AT_REFERENCE = say("seen when the reference was set")
HEAD_DIRECTION_UNKNOWN = say("only the whole region and its volume may gate without the head direction")
MAX_JUMP_FRAMES = 5
"""Most frames that an allowed step counts for: a longer gap does not allow a larger step."""
SURE_RATE = 0.5
"""Least confidence of a breathing rate by which the beam is held."""
_REASON_OF_LOST = {
    LostReason.MARKER_LOST: HoldReason.MARKER_LOST,
    LostReason.LAYOUT_CHANGED: HoldReason.LAYOUT_CHANGED,
    LostReason.COVERAGE_LOW: HoldReason.COVERAGE_LOW,
    LostReason.RESIDUAL_HIGH: HoldReason.RESIDUAL_HIGH,
    LostReason.SURFACE_CHANGED: HoldReason.SURFACE_CHANGED,
    LostReason.CAMERA_MOVED: HoldReason.CAMERA_MOVED,
    LostReason.VALUE_INVALID: HoldReason.VALUE_INVALID,
    LostReason.FRAME_FROZEN: HoldReason.FRAME_FROZEN,
    LostReason.FRAME_TORN: HoldReason.FRAME_FROZEN,
}


class EventKind(enum.StrEnum):
    """Kinds of events, by which the transition table is indexed."""

    INSIDE = "inside"
    DWELT = "dwelt"
    OUTSIDE = "outside"
    UNUSABLE = "unusable"
    FAILURE = "failure"
    ARM = "arm"
    DISARM = "disarm"
    ACKNOWLEDGE = "acknowledge"
    END = "end"


class Verdict(NamedTuple):
    """Kind and reason of an event, the text for the operator, and the window's states where it judged the frame.

    ``stay_from_ns``: where the patient has breathed, the beam-on time of the old stay at which the new one starts.
    """

    kind: EventKind
    reason: HoldReason | None = None
    detail: str = ""
    conditions: tuple[ConditionState, ...] | None = None
    stay_from_ns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LastFrame:
    """Summary of the frames so far, with which the next one is compared.

    ``signals_mm`` were measured ``signal_age_frames`` frames ago.
    """

    index: int
    timestamp_us: int
    received_ns: int
    delivery: Delivery
    signals_mm: tuple[float, ...] | None
    signal_age_frames: int

    @property
    def least_lag_ns(self) -> int:
        """The least host time minus device time so far, plus the allowed drift of the clocks since."""
        return self.delivery.least_lag_ns


def check_frame(
    last: LastFrame | None, frame: Measurement, delivery: Delivery, now_ns: int, limits: GateLimits
) -> Verdict | None:
    """Return why ``frame`` must not be used, faults before holds; None where every check passes.

    ``delivery`` is `delivery_with` of the frame.
    """
    verdict = (
        _refuse_disorder(last, frame, now_ns)
        or _refuse_clock_jump(last, frame, limits)
        or _refuse_clock_rate(delivery, limits)
        or _refuse_late(delivery, frame, now_ns, limits)
        or _refuse_unseen_age(delivery, frame, limits)
        or _refuse_gap(last, frame, limits)
    )
    if verdict is not None:
        return verdict
    if frame.state is not MeasurementState.MEASURING or frame.motion is None:
        return _judge_unmeasured(frame)
    return (
        _refuse_bad_value(frame.motion, limits)
        or _refuse_unknown_part(limits)
        or _refuse_poor_fit(frame.motion, limits)
        or _refuse_unseen(frame.motion, limits)
        or _refuse_jump(last, frame.motion, limits)
        or refuse_irregular(frame, limits.judged_events)
    )


def fault(reason: HoldReason, detail: str) -> Verdict:
    """Return a verdict that latches the gate."""
    return Verdict(EventKind.FAILURE, reason, detail)


def unusable(reason: HoldReason, detail: str) -> Verdict:
    """Return a verdict that holds the gate until frames are good again."""
    return Verdict(EventKind.UNUSABLE, reason, detail)


def last_frame(before: LastFrame | None, frame: Measurement, delivery: Delivery, window: GateWindow) -> LastFrame:
    """Return the summary with which the next frame is compared; ``delivery`` is `delivery_with` of the frame."""
    signals_mm = () if frame.motion is None else _jump_signals_mm(frame.motion, window)
    is_measured = bool(signals_mm) and all(map(math.isfinite, signals_mm))
    earlier_mm = None if before is None else before.signals_mm
    age = 0 if before is None else before.signal_age_frames + 1 + max(frame.missed_frames, 0)
    return LastFrame(
        index=frame.frame_index,
        timestamp_us=frame.timestamp_us,
        received_ns=frame.received_ns,
        delivery=delivery,
        signals_mm=signals_mm if is_measured else earlier_mm,
        signal_age_frames=0 if is_measured else age,
    )


def captured_ns(last: LastFrame, frame: Measurement, limits: GateLimits) -> int:
    """Return when the camera captured ``frame``, on the host's clock [ns]; ``last`` includes it already.

    The fastest frame so far counts as delivered without delay but for ``camera_latency_ms``. The frames of a recording
    count as captured when they are received, because a player may fall behind.
    """
    lag_ns = 0 if limits.is_played else max(lag_of(frame) - last.least_lag_ns, 0)
    return frame.received_ns - lag_ns - ns_from_ms(limits.camera_latency_ms)


def too_slow(latency_ms: float, limits: GateLimits) -> str:
    """Return the text of a latency above its limit."""
    return say(
        "{latency_ms:.0f} ms since the camera took the frame, {max_latency_ms:g} allowed",
        latency_ms=latency_ms,
        max_latency_ms=limits.max_latency_ms,
    )


def delivery_with(before: LastFrame | None, frame: Measurement) -> Delivery:
    """Return what the frames so far show about their delivery, this one included."""
    if before is None or frame.timestamp_us <= before.timestamp_us:
        return followed_delivery(None, frame, 0)  # a first frame, or a device that restarted its clock
    return followed_delivery(before.delivery, frame, frame.received_ns - before.received_ns)


def _refuse_disorder(last: LastFrame | None, frame: Measurement, now_ns: int) -> Verdict | None:
    """Refuse frames whose index or times do not increase, on the device or on the host."""
    if frame.missed_frames < 0:
        return fault(HoldReason.VALUE_INVALID, say("{missed_frames} missed frames", missed_frames=frame.missed_frames))
    disorder = ""
    if frame.received_ns > now_ns:
        disorder = say("received {received_ns} ns after now", received_ns=frame.received_ns - now_ns)
    elif last is None:
        return None
    elif frame.frame_index <= last.index:
        disorder = say("frame {frame_index} after frame {index}", frame_index=frame.frame_index, index=last.index)
    elif frame.timestamp_us <= last.timestamp_us:
        disorder = say(
            "device time {timestamp_us} us after {last_us} us",
            timestamp_us=frame.timestamp_us,
            last_us=last.timestamp_us,
        )
    elif frame.received_ns <= last.received_ns:
        disorder = say(
            "received {received_ns} ns before the last frame", received_ns=last.received_ns - frame.received_ns
        )
    return fault(HoldReason.CLOCK_BACKWARDS, disorder) if disorder else None


def _refuse_clock_jump(last: LastFrame | None, frame: Measurement, limits: GateLimits) -> Verdict | None:
    """Refuse a step of the device's clock beyond that of the host's; a recording's player may catch up."""
    if last is None or limits.is_played:
        return None
    device_ns = (frame.timestamp_us - last.timestamp_us) * NS_PER_US
    ahead_ms = (device_ns - (frame.received_ns - last.received_ns)) / NS_PER_MS
    if ahead_ms <= limits.max_clock_jump_ms:
        return None
    return fault(
        HoldReason.CLOCK_JUMPED,
        say("the camera's clock advanced {ahead_ms:.0f} ms more than the host's", ahead_ms=ahead_ms),
    )


def _refuse_clock_rate(delivery: Delivery, limits: GateLimits) -> Verdict | None:
    """Refuse frames of a device clock that runs at a wrong rate, or whose delay grows all the time."""
    error_ppm = delivery.rate.error_ppm
    if error_ppm is None or limits.is_played or abs(error_ppm) <= MAX_RATE_ERROR_PPM:
        return None
    way = say("faster") if error_ppm > 0.0 else say("slower")
    detail = say(
        "the camera's clock runs {error_ppm:.0f} ppm {way} than the host's, {max_rate_error_ppm:g} allowed",
        error_ppm=abs(error_ppm),
        way=way,
        max_rate_error_ppm=MAX_RATE_ERROR_PPM,
    )
    return fault(HoldReason.CLOCK_JUMPED, detail)


def _refuse_late(delivery: Delivery, frame: Measurement, now_ns: int, limits: GateLimits) -> Verdict | None:
    age_ms = (now_ns - frame.received_ns) / NS_PER_MS
    if age_ms > limits.max_silence_ms:
        return fault(HoldReason.FRAME_STALE, say("the newest frame is {age_ms:.0f} ms old", age_ms=age_ms))
    lag_ms = (lag_of(frame) - delivery.least_lag_ns) / NS_PER_MS
    latency_ms = limits.camera_latency_ms + (0.0 if limits.is_played else lag_ms) + age_ms
    if latency_ms > limits.max_latency_ms:
        return fault(HoldReason.LATENCY_HIGH, too_slow(latency_ms, limits))
    if age_ms > limits.max_frame_age_ms:
        return unusable(HoldReason.FRAME_LATE, say("decided {age_ms:.0f} ms after it was received", age_ms=age_ms))
    if lag_ms > limits.max_lag_ms and not limits.is_played:
        return unusable(
            HoldReason.FRAME_LATE, say("received {lag_ms:.0f} ms later than the fastest frame", lag_ms=lag_ms)
        )
    return None


def _refuse_unseen_age(delivery: Delivery, frame: Measurement, limits: GateLimits) -> Verdict | None:
    """Hold where a backlog may have grown unseen since the last frame that is known to have been fresh."""
    if limits.is_played:
        return None
    unseen_ms = unseen_ageing_ms(delivery, frame)
    if unseen_ms is None or delivery.fresh_ns is None:
        return unusable(
            HoldReason.FRAME_LATE, say("no frame is known to be fresh: frames may wait in the camera's driver")
        )
    lag_ms = (lag_of(frame) - delivery.least_lag_ns) / NS_PER_MS
    since_ns = frame.received_ns - delivery.fresh_ns
    if is_age_known(delivery, frame.received_ns) and lag_ms + unseen_ms <= limits.max_lag_ms:
        return None
    since_s = since_ns / NS_PER_S
    detail = say(
        "{since_s:.1f} s since a frame that is known to be fresh: up to {lag_ms:.0f} ms late",
        since_s=since_s,
        lag_ms=lag_ms + unseen_ms,
    )
    return unusable(HoldReason.FRAME_LATE, detail)


def _refuse_gap(last: LastFrame | None, frame: Measurement, limits: GateLimits) -> Verdict | None:
    if frame.missed_frames > 0:
        return unusable(
            HoldReason.FRAME_MISSING,
            say("{missed_frames} frames lost by the camera", missed_frames=frame.missed_frames),
        )
    if last is None:
        return None
    if frame.frame_index != last.index + 1:
        return unusable(
            HoldReason.FRAME_MISSING,
            say("frame {frame_index} after frame {index}", frame_index=frame.frame_index, index=last.index),
        )
    device_ms = (frame.timestamp_us - last.timestamp_us) * NS_PER_US / NS_PER_MS
    host_ms = (frame.received_ns - last.received_ns) / NS_PER_MS
    gap_ms = max(device_ms, host_ms)
    if gap_ms > limits.max_gap_ms:
        return unusable(HoldReason.FRAME_MISSING, say("{gap_ms:.0f} ms after the last frame", gap_ms=gap_ms))
    return None


def _judge_unmeasured(frame: Measurement) -> Verdict:
    if frame.state is MeasurementState.TRAINING:
        return unusable(HoldReason.TRAINING, say("the motion model is being trained"))
    if frame.state is MeasurementState.LOST and frame.lost is not None:
        reason = _REASON_OF_LOST.get(frame.lost.reason, HoldReason.UNKNOWN)
        kind = EventKind.FAILURE if reason.is_fault else EventKind.UNUSABLE
        return Verdict(kind, reason, frame.lost.detail)
    return fault(HoldReason.VALUE_INVALID, say("{state} without a measurement", state=frame.state))


def _refuse_bad_value(motion: Motion, limits: GateLimits) -> Verdict | None:
    fit = motion.projection
    wide = (motion.whole_mm, motion.thorax_mm, motion.abdomen_mm, fit.residual_mm, fit.valid_share, fit.inlier_share)
    gated: tuple[float, ...] = ()
    for choice in limits.window.choices:
        gated += (choice.value_in(motion),)
    is_fit = fit.residual_mm >= 0.0 and 0.0 <= fit.valid_share <= 1.0 and 0.0 <= fit.inlier_share <= 1.0
    if is_fit and all(map(math.isfinite, (*wide, *gated, *fit.beta.tolist(), *fit.coefficients.tolist()))):
        return None
    return fault(HoldReason.VALUE_INVALID, say("not a number: {bad}", bad=listed(", ", _bad_values(motion, limits))))


def _bad_values(motion: Motion, limits: GateLimits) -> list[str]:
    """Name what is no number, or none that can be."""
    fit = motion.projection
    values = (
        ("whole", motion.whole_mm),
        ("thorax", motion.thorax_mm),
        ("abdomen", motion.abdomen_mm),
        ("residual", fit.residual_mm),
        (say("valid share"), fit.valid_share),
        (say("inlier share"), fit.inlier_share),
    )
    gated = [choice for choice in limits.window.choices if not math.isfinite(choice.value_in(motion))]
    bad: list[str] = [say("{label} (gated)", label=choice.label) for choice in gated]
    bad += [name for name, value in values if not math.isfinite(value)]
    if not all(map(math.isfinite, (*fit.beta.tolist(), *fit.coefficients.tolist()))):
        bad.append("coefficients")
    shares_are = 0.0 <= fit.valid_share <= 1.0 and 0.0 <= fit.inlier_share <= 1.0
    if fit.residual_mm < 0.0 or not shares_are:
        bad.append("fit")
    return bad


def _refuse_unknown_part(limits: GateLimits) -> Verdict | None:
    """Hold where the window is on a part of the patient and the head direction is unknown."""
    if limits.head_direction is not None or not limits.needs_head_direction:
        return None
    return unusable(HoldReason.HEAD_DIRECTION_MISSING, HEAD_DIRECTION_UNKNOWN)


def _refuse_poor_fit(motion: Motion, limits: GateLimits) -> Verdict | None:
    fit = motion.projection
    if not fit.valid_share >= limits.min_valid_share:
        detail = say(
            "{valid_share:.2f} of the region visible, {min_valid_share:.2f} needed",
            valid_share=fit.valid_share,
            min_valid_share=limits.min_valid_share,
        )
        return unusable(HoldReason.COVERAGE_LOW, detail)
    if not fit.inlier_share >= limits.min_inlier_share:
        detail = say(
            "{inlier_share:.2f} of the visible region fits the model, {min_inlier_share:.2f} needed",
            inlier_share=fit.inlier_share,
            min_inlier_share=limits.min_inlier_share,
        )
        return unusable(HoldReason.RESIDUAL_HIGH, detail)
    if not fit.residual_mm <= limits.max_residual_mm:
        detail = say(
            "residual {residual_mm:.2f} mm, {max_residual_mm:.2f} mm allowed",
            residual_mm=fit.residual_mm,
            max_residual_mm=limits.max_residual_mm,
        )
        return unusable(HoldReason.RESIDUAL_HIGH, detail)
    return None


def unseen_signal(seen: SeenShares, limits: GateLimits, when: str = "seen") -> str | None:
    """Return which gated signal the camera sees too little of, and how much; None if there is none.

    The motion model extrapolates what is not seen, so such a signal has a value that was not measured.
    """
    for choice in limits.window.choices:
        needed = limits.min_wide_share if choice.is_wide else limits.min_signal_share
        share = choice.seen_in(seen)
        if not needed <= share <= 1.0:
            return say(
                "{label}: {share:.2f} of its area {when}, {needed:.2f} needed",
                label=choice.label,
                share=share,
                when=when,
                needed=needed,
            )
    return None


def _refuse_unseen(motion: Motion, limits: GateLimits) -> Verdict | None:
    """Hold where any gated signal is not measurable, also one of a window whose other condition would be met."""
    detail = unseen_signal(motion.seen, limits) or unseen_signal(motion.reference_seen, limits, SEEN_AT_REFERENCE)
    return None if detail is None else unusable(HoldReason.COVERAGE_LOW, detail)


def _jump_signals_mm(motion: Motion, window: GateWindow) -> tuple[float, ...]:
    """Return the signals checked for jumps: the gated ones in mm, or the whole region for a volume."""
    lengths: tuple[float, ...] = ()
    for choice in window.choices:
        if not choice.is_volume:
            lengths += (choice.value_in(motion),)
    return lengths or (motion.whole_mm,)


def _refuse_jump(last: LastFrame | None, motion: Motion, limits: GateLimits) -> Verdict | None:
    if last is None or last.signals_mm is None:
        return None
    frames = min(last.signal_age_frames + 1, MAX_JUMP_FRAMES)  # this frame missed none: `_refuse_gap`
    signals_mm = _jump_signals_mm(motion, limits.window)
    for now_mm, before_mm in zip(signals_mm, last.signals_mm, strict=True):
        step_mm = abs(now_mm - before_mm)
        if not step_mm <= limits.max_jump_mm * frames:
            return unusable(HoldReason.JUMP, say("{step_mm:.1f} mm in {frames} frames", step_mm=step_mm, frames=frames))
    return None


def refuse_irregular(frame: Measurement, holding: frozenset[BreathEventKind]) -> Verdict | None:
    """Hold where breathing has ceased, and for the further breathing events that the site chose."""
    for breath in frame.breaths:
        for event in breath.events:
            if event.kind in holding:
                return unusable(
                    HoldReason.BREATHING_IRREGULAR, say("{kind}: {detail}", kind=event.kind, detail=event.detail)
                )
    return None


def refuse_rate(frame: Measurement, limits: GateLimits) -> Verdict | None:
    """Hold where the gated breathing is slower or faster than is gated, if its rate is known well enough."""
    low, high = limits.min_breaths_per_min, limits.max_breaths_per_min
    for breath in frame.breaths:
        rate = breath.rate_per_min
        if rate is None or breath.signal not in limits.window.choices or breath.rate_confidence < SURE_RATE:
            continue
        if not low <= rate <= high:
            detail = say(
                "{label}: {rate:.0f} breaths a minute, {low:g} to {high:g} are gated",
                label=breath.signal.label,
                rate=rate,
                low=low,
                high=high,
            )
            return unusable(HoldReason.BREATHING_IRREGULAR, detail)
    return None
