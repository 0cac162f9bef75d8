"""How each interlock is tripped in a live run."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

from engine.core.breath import Breath, BreathEvent, BreathEventKind
from engine.core.clock import NS_PER_MS
from engine.core.commands import HoldBeam, ReleaseBeam
from engine.core.errors import SourceEndedError, SourceLostError
from engine.core.frames import LostReason, Measurement, MeasurementState, RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.gating.supervision.supervisor import NS_PER_MIN
from tests.support.gating.streams import EVIDENCE, LEVEL_MM, unmeasured
from verification.interlocks.live_camera import Mischief, wait_ns
from verification.interlocks.live_run import LIMITS, TRANSITIONS_KEPT, LiveRun, Trip

GOOD = Mischief()
EARLY_ENOUGH_NS = 3_000 * NS_PER_MS
"""A machine that is busy holds the beam now and then: time to have it on again."""

COUGH = Breath(
    exhale_drift=0.0,
    events=(BreathEvent(kind=BreathEventKind.COUGH, start_us=0, confidence=1.0, detail="two spikes"),),
)


def _wrong(**what: object) -> Callable[[LiveRun], None]:
    def act(run: LiveRun) -> None:
        for name, value in what.items():
            setattr(run.mischief, name, value)

    return act


def _right(run: LiveRun) -> None:
    """Nothing is wrong any more, except for how often pictures come, which is asked for by its own trip."""
    for name in Mischief.__slots__:
        setattr(run.mischief, name, getattr(GOOD, name))


def _spoiled(spoil: Callable[[Measurement], Measurement]) -> Callable[[LiveRun], None]:
    return _wrong(spoil=spoil)


def _lost(reason: LostReason) -> Callable[[LiveRun], None]:
    return _spoiled(lambda frame: unmeasured(frame, MeasurementState.LOST, reason))


def _motion(**changes: object) -> Callable[[LiveRun], None]:
    return _spoiled(lambda frame: replace(frame, motion=replace(frame.motion, **changes)))


def _fit(**changes: object) -> Callable[[LiveRun], None]:
    return _spoiled(
        lambda frame: replace(
            frame, motion=replace(frame.motion, projection=replace(frame.motion.projection, **changes))
        )
    )


def _lower(frame: Measurement) -> Measurement:
    breath = Breath(amplitude=12.0, exhale_us=frame.timestamp_us, exhale_drift=-4.0)
    return replace(frame, breaths=(breath,))


def _without_scene(frame: Measurement) -> Measurement:
    return replace(frame, evidence=EVIDENCE._replace(camera=False))


def _jumping(frame: Measurement) -> Measurement:
    """To and fro from frame to frame."""
    whole_mm = LEVEL_MM - 4.5 * (frame.frame_index % 2)
    return replace(frame, motion=replace(frame.motion, whole_mm=whole_mm))


def _earlier_by(us: int) -> Callable[[RgbdFrame], RgbdFrame]:
    def edit(frame: RgbdFrame) -> RgbdFrame:
        taken_us = frame.timestamp_us - us
        return replace(frame, timestamp_us=taken_us, color_timestamp_us=taken_us)

    return edit


def _backlog(run: LiveRun) -> None:
    """Each frame comes 30 ms later after it was taken than the one before: a driver that queues."""
    behind_us, last_us = 0, 0

    def edit(frame: RgbdFrame) -> RgbdFrame:
        nonlocal behind_us, last_us
        behind_us += 30_000
        last_us = max(last_us + 1_000, frame.timestamp_us - behind_us)  # order is kept, however frames come
        return replace(frame, timestamp_us=last_us, color_timestamp_us=last_us)

    run.mischief.edit = edit


def _pipeline(**what: object) -> Callable[[LiveRun], None]:
    def act(run: LiveRun) -> None:
        for name, value in what.items():
            setattr(run.pipeline, name, value)

    return act


def _model_back(run: LiveRun) -> None:
    run.pipeline.model = object()  # type: ignore[assignment]


def _found_alike(run: LiveRun) -> None:
    notice = LearningEvent(
        kind=LearningEventKind.COMPARED, detail="alike", timestamp_us=0, figures={"is_accepted": True}
    )
    run.pipeline.notices.append(notice)
    run.learned_ns = run.clock.now_ns()


def _minute_old(run: LiveRun) -> int:
    """Wait until the model was learned almost a minute ago, see that the beam is on, return when the minute is over."""
    over_ns = (run.learned_ns or run.records[0].received_ns) + NS_PER_MIN
    wait_ns(over_ns - EARLY_ENOUGH_NS - run.clock.now_ns())
    with contextlib.suppress(AssertionError):  # off at the end of the minute: it is tried again with another
        run.turn_on()
    wait_ns(over_ns - run.clock.now_ns())
    return over_ns


def _line(**what: bool) -> Callable[[LiveRun], None]:
    def act(run: LiveRun) -> None:
        for name, value in what.items():
            setattr(run.beam, name, value)

    return act


def _run(**what: bool) -> Callable[[LiveRun], None]:
    def act(run: LiveRun) -> None:
        for name, value in what.items():
            setattr(run, name, value)

    return act


def _fill_audit(run: LiveRun) -> None:
    """No one takes the transitions any more, and as many wait as may: the last of those there were, again and again."""
    run.is_auditing = False
    run.frames(3)
    while run.loop.transitions.qsize() < TRANSITIONS_KEPT:
        run.loop.transitions.put_nowait(run.transitions[-1])


def _disk_low(run: LiveRun) -> None:
    run.loop.report_fault(HoldReason.DISK_LOW, "20 MB left")


def _hold(run: LiveRun) -> None:
    run.loop.submit(HoldBeam(operator="bob"))


def _release(run: LiveRun) -> None:
    run.loop.submit(ReleaseBeam(operator="ann")).result(timeout=5.0)


def _stick(run: LiveRun) -> None:
    run.is_beam_stuck = True
    _hold(run)


def _let_go(run: LiveRun) -> None:
    run.is_beam_stuck = False
    _release(run)


def _stop(run: LiveRun) -> None:
    run.loop.stop(timeout_s=10.0)


R = HoldReason

TRIPS: tuple[Trip, ...] = (
    Trip(code=R.FRAME_STALE, how="measuring one frame takes 400 ms", act=_wrong(dawdle_ms=400.0)),
    Trip(code=R.FRAME_LATE, how="measuring one frame takes 120 ms", act=_wrong(dawdle_ms=120.0)),
    Trip(code=R.FRAME_MISSING, how="no frame comes, for a moment", act=_wrong(is_silent=True), undo=_right),
    Trip(code=R.FRAME_TIMEOUT, how="no frame comes any more", act=_wrong(is_silent=True), undo=_right),
    Trip(code=R.FRAME_FROZEN, how="the same picture with new times", act=_wrong(is_frozen=True), undo=_right),
    Trip(code=R.FRAME_RATE_LOW, how="11 frames a second", act=_wrong(period_ns=90 * NS_PER_MS), undo=_right),
    Trip(
        code=R.CLOCK_BACKWARDS, how="the camera's clock goes back 1 s", act=_wrong(edit=_earlier_by(10**6)), undo=_right
    ),
    Trip(
        code=R.CLOCK_JUMPED,
        how="the camera's clock jumps 1 s ahead",
        act=_wrong(edit=_earlier_by(-(10**6))),
        undo=_right,
    ),
    Trip(code=R.LATENCY_HIGH, how="frames queue up in the driver", act=_backlog, undo=_right),
    Trip(
        code=R.SOURCE_LOST,
        how="the camera is unplugged",
        act=_wrong(error=SourceLostError("unplugged")),
        ends_session=True,
    ),
    Trip(code=R.MARKER_LOST, how="a marker is hidden", act=_lost(LostReason.MARKER_LOST), undo=_right),
    Trip(code=R.LAYOUT_CHANGED, how="a marker is moved", act=_lost(LostReason.LAYOUT_CHANGED), undo=_right),
    Trip(code=R.BASELINE_DRIFTED, how="the end of exhale is 4 mm lower", act=_spoiled(_lower), undo=_right),
    Trip(code=R.PATIENT_SHIFTED, how="all markers lie 7 mm aside", act=_wrong(shift_mm=7.0), undo=_right),
    Trip(code=R.COVERAGE_LOW, how="half of the region is seen", act=_fit(valid_share=0.5), undo=_right),
    Trip(code=R.RESIDUAL_HIGH, how="4 mm are left unexplained", act=_fit(residual_mm=4.0), undo=_right),
    Trip(code=R.SURFACE_CHANGED, how="a sheet is laid down", act=_lost(LostReason.SURFACE_CHANGED), undo=_right),
    Trip(code=R.CAMERA_MOVED, how="the camera is pushed", act=_lost(LostReason.CAMERA_MOVED), undo=_right),
    Trip(code=R.CHECK_MISSING, how="couch and floor are hidden", act=_spoiled(_without_scene), undo=_right),
    Trip(code=R.JUMP, how="the signal steps by 4.5 mm, inside the window", act=_spoiled(_jumping), undo=_right),
    Trip(code=R.VALUE_INVALID, how="the motion is no number", act=_motion(thorax_mm=math.nan), undo=_right),
    Trip(code=R.BREATHING_IRREGULAR, how="the patient coughs", act=_wrong(breaths=(COUGH,)), undo=_right),
    Trip(code=R.MODEL_MISSING, how="the model is gone", act=_pipeline(model=None), undo=_model_back),
    Trip(
        code=R.TRAINING,
        how="the model is being learned",
        act=_spoiled(lambda frame: unmeasured(frame, MeasurementState.TRAINING)),
        undo=_right,
    ),
    Trip(
        code=R.REFERENCE_MISSING,
        how="the zero is gone",
        act=_pipeline(has_reference=False),
        undo=_pipeline(has_reference=True),
    ),
    Trip(
        code=R.POSITION_UNCHECKED,
        how="the position is to be signed, and is not",
        act=_pipeline(is_position_required=True),
        undo=_pipeline(is_position_required=False),
    ),
    Trip(
        code=R.RECORDER_BEHIND,
        how="nobody takes the samples",
        act=_run(is_recording=False),
        undo=_run(is_recording=True),
    ),
    Trip(code=R.DISK_LOW, how="the writer reports a full disk", act=_disk_low),
    Trip(
        code=R.BEAM_LINE_FAILED, how="the line's answers are lost", act=_line(is_deaf=True), undo=_line(is_deaf=False)
    ),
    Trip(
        code=R.BEAM_LINE_MISMATCH,
        how="the line's answers lie",
        act=_line(is_lied_to=True),
        undo=_line(is_lied_to=False),
    ),
    Trip(
        code=R.BEAM_WITHOUT_PERMIT,
        how="the accelerator reports beam on after a person's hold",
        act=_stick,
        undo=_let_go,
    ),
    Trip(code=R.WATCHDOG, how="the camera's driver hangs for 700 ms", act=_wrong(hang_ms=700.0)),
    Trip(code=R.OPERATOR_HOLD, how="somebody presses hold", act=_hold, undo=_release),
    Trip(code=R.OPERATOR_LOST, how="the page falls silent", act=_run(is_present=False), undo=_run(is_present=True)),
    Trip(
        code=R.SERVICE_SILENT,
        how="the service's process falls silent",
        act=_run(is_service_alive=False),
        undo=_run(is_service_alive=True),
    ),
    Trip(code=R.AUDIT_BEHIND, how="nobody takes the transitions", act=_fill_audit, undo=_run(is_auditing=True)),
    Trip(code=R.ENGINE_FAILED, how="measuring raises", act=_wrong(bug=ZeroDivisionError("oh")), ends_session=True),
    Trip(code=R.ENGINE_STOPPED, how="the session is stopped", act=_stop, ends_session=True),
    Trip(
        code=R.SOURCE_ENDED, how="the recording is over", act=_wrong(error=SourceEndedError("over")), ends_session=True
    ),
    Trip(
        code=R.BEAM_ON_LIMIT,
        how="the breath is held inside the window",
        act=_wrong(),
        undo=LiveRun.leave_window,
        limits=replace(LIMITS, max_beam_on_s=2.0),
    ),
    Trip(
        code=R.MODEL_OLD,
        how="a minute after the model was learned",
        act=_minute_old,
        undo=_found_alike,
        limits=replace(LIMITS, max_model_age_min=1.0),
    ),
)
