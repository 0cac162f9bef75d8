"""From what the engine says to what goes out: live messages and views. Pure; NaN and inf leave as null."""

import math
from datetime import UTC, datetime

from engine.frames import Measurement, Motion, PhaseLag
from engine.likeness import Likeness
from engine.live import LiveView, LoopStatus
from service import schemas
from service.breath_view import live_breath, live_breath_hold
from service.hold_texts import hold_text
from service.live_messages import LiveLag, LiveLatency, LiveLost, LiveTraining, Sample
from service.ports import SessionPlan
from service.uncalibrated import kind_of
from service.window_view import live_window

DIGITS = 4
NEVER = datetime(1970, 1, 1, tzinfo=UTC)


def known(value: float | None) -> float | None:
    """Return a measured value, or None for what could not be measured."""
    return None if value is None or not math.isfinite(value) else float(value)


def _rounded(value: float | None) -> float | None:
    finite = known(value)
    return None if finite is None else round(finite, DIGITS)


def live_sample(view: LiveView, plan: SessionPlan, *, is_stopping: bool, is_simulated_beam: bool) -> Sample:
    """Make the live message of a view; number, send time and age are the sender's to fill in."""
    record, measurement = view.record, view.record.measurement
    motion = measurement.motion
    projection = None if motion is None else motion.projection
    return Sample(
        sequence=0,
        sent_at=NEVER,
        age_ms=0.0,
        session_id=plan.session_id,
        session_status=_session_status(view.status, is_stopping=is_stopping),
        is_armed=view.is_armed,
        is_simulated_beam=is_simulated_beam,
        calibration=kind_of(plan.calibration.camera),
        frame_index=measurement.frame_index,
        timestamp_us=measurement.timestamp_us,
        state=measurement.state.value,
        lost=_lost(measurement),
        training=_training(measurement),
        gate=record.gate_state.value,
        hold_reason=None if record.hold_reason is None else record.hold_reason.value,
        hold_text=hold_text(record.hold_reason),
        hold_detail="" if record.hold_reason is None else view.detail,
        operator_hold=view.operator_hold,
        line_on=record.line_on,
        window=live_window(view.window, view.conditions, measurement),
        breath=live_breath(view),
        breath_hold=live_breath_hold(view),
        signal_mm=_rounded(record.signal_mm),
        whole_mm=None if motion is None else _rounded(motion.whole_mm),
        thorax_mm=None if motion is None else _rounded(motion.thorax_mm),
        abdomen_mm=None if motion is None else _rounded(motion.abdomen_mm),
        volume_l=None if motion is None else _rounded(motion.volume_l),
        residual_mm=None if projection is None else _rounded(projection.residual_mm),
        valid_share=None if projection is None else _rounded(projection.valid_share),
        regions_mm=None if motion is None else [[_rounded(cell) for cell in row] for row in motion.regions_mm.tolist()],
        named_mm=_named(motion, plan),
        split_rows=None
        if motion is None or motion.split_rows is None
        else [round(row, 2) for row in motion.split_rows],
        lags=None if motion is None else [_lag(lag) for lag in motion.lags],
        roi_px=_corners(measurement),
        fps=_rounded(view.fps),
        frames=view.frames,
        missed_frames=view.missed_frames,
        latency_ms=LiveLatency(
            last=_rounded(view.latency.last_ms),
            p50=_rounded(view.latency.p50_ms),
            p99=_rounded(view.latency.p99_ms),
            max=_rounded(view.latency.max_ms),
            warned=view.latency.is_warned,
        ),
    )


def gate_view(view: LiveView) -> schemas.GateView:
    """Tell where the gate stands."""
    record = view.record
    return schemas.GateView(
        state=record.gate_state.value,
        is_armed=view.is_armed,
        hold_reason=None if record.hold_reason is None else record.hold_reason.value,
        hold_text=hold_text(record.hold_reason),
        hold_detail="" if record.hold_reason is None else view.detail,
        operator_hold=view.operator_hold,
        line_on=record.line_on,
    )


def training_view(view: LiveView) -> schemas.TrainingView | None:
    """Tell how far the learning has come."""
    training = _training(view.record.measurement)
    return None if training is None else schemas.TrainingView.model_validate(training.model_dump())


def likeness_view(likeness: Likeness | None) -> schemas.LikenessView | None:
    """Tell how far the patient is from the stored model."""
    if likeness is None:
        return None
    return schemas.LikenessView(
        is_accepted=likeness.refusal is None,
        refusal=None if likeness.refusal is None else str(likeness.refusal),
        frames=likeness.frames,
        explained_share=round(likeness.explained_share, DIGITS),
        residual_mm=_rounded(likeness.residual_mm),
        shift_mm=[round(value, DIGITS) for value in likeness.shift_mm],
        tilt_deg=round(likeness.tilt_deg, DIGITS),
        shape_mm=round(likeness.shape_mm, DIGITS),
    )


def _session_status(status: LoopStatus, *, is_stopping: bool) -> str:
    if status is LoopStatus.FAILED:
        return "failed"
    if not status.is_over:
        return "running"
    return "stopped" if is_stopping else "ended"


def _lost(measurement: Measurement) -> LiveLost | None:
    lost = measurement.lost
    return None if lost is None else LiveLost(reason=lost.reason.value, detail=lost.detail)


def _training(measurement: Measurement) -> LiveTraining | None:
    training = measurement.training
    if training is None:
        return None
    return LiveTraining(
        frames=training.frames,
        cycles=training.cycles,
        seconds=round(training.seconds, 2),
        share=round(training.share, 3),
        note=training.note,
        amplitude_mm=_rounded(training.amplitude_mm),
        shift_mm=_rounded(training.shift_mm),
    )


def _named(motion: Motion | None, plan: SessionPlan) -> dict[str, float | None] | None:
    if motion is None:
        return None
    names = [region.name for region in plan.regions.named]
    return {name: _rounded(value) for name, value in zip(names, motion.named_mm.tolist(), strict=False)}


def _lag(lag: PhaseLag) -> LiveLag:
    return LiveLag(
        first=lag.first,
        second=lag.second,
        lag_s=_rounded(lag.lag_s),
        lag_deg=_rounded(lag.lag_deg),
        period_s=_rounded(lag.period_s),
        confidence=_rounded(lag.confidence),
        note=lag.note,
    )


def _corners(measurement: Measurement) -> list[list[float]] | None:
    markers = measurement.markers
    return None if markers is None else [[round(x, 2), round(y, 2)] for x, y in markers.centers_px.tolist()]
