"""Live messages and views from the engine's newest view. Pure functions; NaN and infinity become null.

The newest frame's surface as a mesh, computed in the service on request, never in the engine.
"""

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Literal

from engine.beam import BeamOnState
from engine.calibration import Calibration
from engine.capture import SourceDescription
from engine.control import LiveView, LoopStatus
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, Measurement, Motion, PhaseLag
from engine.core.learning_status import PatientMatch
from engine.core.position_check import CameraView
from engine.motion import surface_mesh
from service.core.alarm_table import hold_text
from service.core.errors import MeshMissingError
from service.core.schemas import sessions
from service.core.schemas.base import finite_or_none, rounded_or_none
from service.core.schemas.live_messages import (
    LiveCameraView,
    LiveLag,
    LiveLatency,
    LiveLost,
    LivePosition,
    LiveTraining,
    Sample,
)
from service.core.schemas.sentences import sentence_parts
from service.engine_host.protocols import BodyMatch, SessionPlan
from service.engine_host.site_limits.calibrations import kind_of, serial_warning
from service.sessions.views.breath import live_breath, live_breath_hold, live_window
from service.sessions.views.interlocks import live_checks
from service.sessions.views.position import live_position_check, live_reference

DIGITS = 4
POSITION_DIGITS = 2
NEVER = datetime(1970, 1, 1, tzinfo=UTC)
NOT_MEASURED: dict[str, Any] = dict.fromkeys(
    (
        *("whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "residual_mm", "valid_share"),
        *("regions_mm", "named_mm", "split_rows", "lags"),
    )
)
SURFACE_DIGITS = 3


def live_sample(
    view: LiveView, plan: SessionPlan, *, is_stopping: bool, is_simulated_beam: bool, body: BodyMatch | None = None
) -> Sample:
    """Make the live message of a view; the stream fills in sequence number, send time and age."""
    record, measurement = view.record, view.record.measurement
    sample = Sample(
        sequence=0,
        sent_at=NEVER,
        age_ms=0.0,
        session_id=plan.session_id,
        session_status=_session_status(view.status, is_stopping=is_stopping),
        is_armed=view.is_armed,
        is_simulated_beam=is_simulated_beam,
        calibration=kind_of(plan.calibration.camera),
        body_warning=None if body is None else body.warning,
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
        operator_holds=list(view.operator_holds),
        armed_by=view.armed_by,
        line_on=record.line_on,
        accelerator_beam=_accelerator_beam(view.beam_on),
        window=live_window(view.window, view.conditions, measurement),
        breath=live_breath(view),
        breath_hold=live_breath_hold(view),
        reference=live_reference(view),
        position_check=live_position_check(view, plan),
        position=_position(view),
        checks=live_checks(view),
        camera_view=_camera_view(view.camera_view),
        signal_mm=rounded_or_none(record.signal_mm),
        **(NOT_MEASURED if measurement.motion is None else _motion_fields(measurement.motion, plan)),
        unseen_cells=None if measurement.motion is None else [list(cell) for cell in view.unseen_cells],
        roi_px=_corners(measurement),
        fps=rounded_or_none(view.fps),
        frames=view.frames,
        missed_frames=view.missed_frames,
        latency_ms=_latency(view),
    )
    return sample.model_copy(update={"sentences": sentence_parts(sample)})


def body_view(match: BodyMatch | None) -> sessions.BodyView | None:
    """Return the comparison with the patient's earlier session."""
    if match is None:
        return None
    return sessions.BodyView(
        session_id=match.session_id,
        model_id=match.model_id,
        shift_mm=[round(value, 2) for value in match.shift_mm],
        tilt_deg=round(match.tilt_deg, 2),
        shape_mm=round(match.shape_mm, 2),
        is_position_compared=match.is_position_compared,
        warning=match.warning,
    )


def camera_view(source: SourceDescription | None, calibration: Calibration) -> sessions.CameraView | None:
    """Return the opened camera, compared with the calibration; None before it is open."""
    if source is None:
        return None
    found = serial_warning(calibration, source)
    return sessions.CameraView(
        name=source.name,
        serial=source.serial or None,
        code=None if found is None else found.code,
        warning=None if found is None else found.text,
    )


def _motion_fields(motion: Motion, plan: SessionPlan) -> dict[str, Any]:
    return {
        "whole_mm": rounded_or_none(motion.whole_mm),
        "thorax_mm": rounded_or_none(motion.thorax_mm),
        "abdomen_mm": rounded_or_none(motion.abdomen_mm),
        "volume_l": rounded_or_none(motion.volume_l),
        "residual_mm": rounded_or_none(motion.projection.residual_mm),
        "valid_share": rounded_or_none(motion.projection.valid_share),
        "regions_mm": [[rounded_or_none(cell) for cell in row] for row in motion.regions_mm.tolist()],
        "named_mm": _named(motion, plan),
        "split_rows": None if motion.split_rows is None else [round(row, 2) for row in motion.split_rows],
        "lags": [_lag(lag) for lag in motion.lags],
    }


def _position(view: LiveView) -> LivePosition | None:
    measurement, moved = view.record.measurement, view.movement
    if measurement.motion is None:
        return None
    surface = measurement.position
    return LivePosition(
        shift_mm=None if moved is None else rounded_or_none(moved.shift_mm, POSITION_DIGITS),
        turn_deg=None if moved is None else rounded_or_none(moved.turn_deg, POSITION_DIGITS),
        travel_mm=rounded_or_none(view.marker_travel_mm, POSITION_DIGITS),
        height_mm=None if surface is None else rounded_or_none(surface.height_mm, POSITION_DIGITS),
        tilt_deg=None if surface is None else rounded_or_none(surface.tilt_deg, POSITION_DIGITS),
        roll_deg=None if surface is None else rounded_or_none(surface.roll_deg, POSITION_DIGITS),
    )


def _camera_view(found: CameraView | None) -> LiveCameraView | None:
    if found is None:
        return None
    return LiveCameraView(
        distance_mm=rounded_or_none(found.distance_mm, 0),
        tilt_deg=rounded_or_none(found.tilt_deg, 1),
        coverage=round(found.coverage, 3),
        brightness=round(found.brightness, 2),
        saturated=round(found.saturated, 3),
        running_s=round(found.running_s),
        warm_in_s=math.ceil(found.warm_in_s),
        advice=[advice.value for advice in found.advice],
    )


def _latency(view: LiveView) -> LiveLatency:
    return LiveLatency(
        last=rounded_or_none(view.latency.last_ms),
        p50=rounded_or_none(view.latency.p50_ms),
        p99=rounded_or_none(view.latency.p99_ms),
        max=rounded_or_none(view.latency.max_ms),
        warned=view.latency.is_warned,
    )


def gate_view(
    view: LiveView,
    newest_arming: tuple[str, datetime] | None,
    newest_change: tuple[Mapping[str, Any], datetime] | None = None,
) -> sessions.GateView:
    """Return the state of the gate, with the reason for a hold.

    The newest arming is by whom and when; the newest change, as the audit has it, may be older than the view.
    """
    is_in_force = newest_arming is not None and newest_arming[0] == view.armed_by
    record = view.record
    reason = None if record.hold_reason is None else record.hold_reason.value
    present = {"to_state": record.gate_state.value, "reason": reason}
    is_recorded = newest_change is not None and present.items() <= newest_change[0].items()
    return sessions.GateView(
        state=record.gate_state.value,
        is_armed=view.is_armed,
        hold_reason=reason,
        hold_text=hold_text(record.hold_reason),
        hold_detail="" if record.hold_reason is None else view.detail,
        state_since=newest_change[1] if newest_change is not None and is_recorded else None,
        operator_hold=view.operator_hold,
        operator_holds=list(view.operator_holds),
        armed_by=view.armed_by,
        armed_at=newest_arming[1] if newest_arming is not None and is_in_force else None,
        line_on=record.line_on,
    )


def training_view(view: LiveView) -> sessions.TrainingView | None:
    """Return the progress of the training; None while none runs."""
    training = _training(view.record.measurement)
    return None if training is None else sessions.TrainingView.model_validate(training.model_dump())


def likeness_view(likeness: PatientMatch | None) -> sessions.LikenessView | None:
    """Return the comparison of the patient with the stored model; None without one."""
    if likeness is None:
        return None
    return sessions.LikenessView(
        is_accepted=likeness.refusal is None,
        refusal=None if likeness.refusal is None else str(likeness.refusal),
        frames=likeness.frames,
        explained_share=round(likeness.explained_share, DIGITS),
        residual_mm=rounded_or_none(likeness.residual_mm),
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
    lost = measurement.reason
    if lost is None:
        return None
    moved, moved_mm = (None, None) if lost.moved is None else (lost.moved.mover.value, round(lost.moved.by_mm, DIGITS))
    return LiveLost(reason=lost.reason.value, detail=lost.detail, moved=moved, moved_mm=moved_mm)


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
        amplitude_mm=rounded_or_none(training.amplitude_mm),
        shift_mm=rounded_or_none(training.shift_mm),
    )


def _named(motion: Motion, plan: SessionPlan) -> dict[str, float | None]:
    names = [region.name for region in plan.regions.named]
    return {name: rounded_or_none(value) for name, value in zip(names, motion.named_mm.tolist(), strict=False)}


def _lag(lag: PhaseLag) -> LiveLag:
    return LiveLag(
        first=lag.first,
        second=lag.second,
        lag_s=rounded_or_none(lag.lag_s),
        lag_deg=rounded_or_none(lag.lag_deg),
        period_s=rounded_or_none(lag.period_s),
        confidence=rounded_or_none(lag.confidence),
        note=lag.note,
    )


def _corners(measurement: Measurement) -> list[list[float]] | None:
    markers = measurement.markers
    return None if markers is None else [[round(x, 2), round(y, 2)] for x, y in markers.centers_px.tolist()]


def _accelerator_beam(state: BeamOnState | None) -> Literal["on", "off", "unknown"] | None:
    """Return what the accelerator's beam-on signal reads; None where there is no signal."""
    if state is None:
        return None
    return "unknown" if state.is_on is None else "on" if state.is_on else "off"


def mesh_answer(view: LiveView | None) -> sessions.SurfaceMesh:
    """Return the surface of the newest frame; raise MeshMissingError where it was not measured."""
    measurement = None if view is None else view.record.measurement
    motion = None if measurement is None else measurement.motion
    if measurement is None or motion is None or len(motion.surface_mm) != NODE_ROWS * NODE_COLUMNS:
        msg = "the session does not run, or its newest frame was not measured"
        raise MeshMissingError(msg)
    mesh = surface_mesh(motion.surface_mm, NODE_ROWS, NODE_COLUMNS)
    return sessions.SurfaceMesh(
        frame_index=measurement.frame_index,
        timestamp_us=measurement.timestamp_us,
        rows=NODE_ROWS,
        columns=NODE_COLUMNS,
        volume_l=finite_or_none(motion.volume_l),
        vertices_mm=mesh.vertices_mm.round(SURFACE_DIGITS).tolist(),
        triangles=mesh.triangles.tolist(),
    )
