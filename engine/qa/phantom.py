"""QA on a moving phantom: accuracy of the measured motion, and delays of the gate.

The phantom is measured and gated by the pipeline and the gate that are used in treatment. A decision's time is the
frame's arrival plus the time of computation. The arrival of a live frame includes its lateness relative to the earliest
one; a recording holds no arrival times, so its frames arrive when they are captured. The site's camera latency, where
it was measured, is added before both.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from engine.core.clock import ManualClock, MonotonicClock
from engine.core.errors import TidegateError
from engine.core.frames import MeasurementState, frozen
from engine.core.reference import ReferenceMoment
from engine.gating.windows import AmplitudeWindow
from engine.motion.learning.learner import Learner
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.offline.offline_gate import Edge, TimedFrame, gate_edges, time_frames
from engine.qa.bounds import not_measured
from engine.qa.inputs import PhantomInput
from engine.qa.motion import MotionAgreement, commanded_zero_mm, compare_motion, longest_outside_s
from engine.qa.playing import frames_of, opened
from engine.qa.results import QaCurve, QaFigure, QaNeed, QaSeries
from engine.qa.sine import Estimate, GateTiming, find_cycles, time_gate_by_sines

Grid = npt.NDArray[np.float64]
MS_PER_S = 1e3
US_PER_MS = 1e3
MAX_POINTS = 1500
MOTION_CODES = (
    "motion_offset_mm",
    "motion_error_mm",
    "motion_error_p95_mm",
    "motion_amplitude_ratio",
    "motion_lag_ms",
)
GATE_CODES = (
    "gate_mean_delay_ms",
    "gate_delay_difference_ms",
    "gate_delay_on_ms",
    "gate_delay_off_ms",
    "beam_outside_ms",
    "duty_cycle_change_percent",
)


class ProposedReference(NamedTuple):
    """Device time of the first frame measured against the proposed reference [us], and of how many ends of exhale."""

    at_us: int
    exhales: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhantomRun:
    """A measured and gated phantom; times are on the trace's clock [s].

    Attributes
    ----------
    time_s, measured_mm
        Times and motion [mm] of the measured frames, shape (n,).
    reference_mm
        Commanded position of the reference, the lag removed: mean of the last ends of exhale, or the first of these.
    agreement
        Agreement of measured and commanded motion, or the reason why it is unknown.
    lost_share
        Share of the frames after the reference without a motion, 0 to 1.
    intervals_s
        Beam-on intervals (on, off).
    undwelt_s
        The same intervals without the dwell.
    still_on_s
        Start of an interval that was still open at the last frame; None if the beam was off.
    dwell_s
        Mean dwell: the configured dwell, plus a part of a frame.
    ends_s
        Time of the last frame.
    """

    time_s: Grid
    measured_mm: Grid
    reference_mm: float
    agreement: MotionAgreement | str
    lost_share: float
    intervals_s: tuple[tuple[float, float], ...]
    undwelt_s: tuple[tuple[float, float], ...]
    dwell_s: float
    ends_s: float
    still_on_s: float | None = None

    @property
    def beam_on_s(self) -> tuple[tuple[float, float], ...]:
        """Beam-on intervals, with an open last interval ending at the last frame."""
        return self.intervals_s if self.still_on_s is None else (*self.intervals_s, (self.still_on_s, self.ends_s))


def measure_phantom(phantom: PhantomInput, on_frame: Callable[[int], None]) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure and gate the phantom; if that is not possible, every phantom check fails with the reason."""
    try:
        with opened(phantom.source) as description:
            frames, proposed = _measure_frames(phantom, on_frame, is_live=description.is_live)
    except TidegateError as error:
        return not_measured(QaNeed.PHANTOM, str(error)), []
    run = run_of(phantom, frames, is_live=description.is_live, proposed=proposed)
    if isinstance(run, str):
        return not_measured(QaNeed.PHANTOM, run), []
    return figures_of(phantom, run), series_of(phantom, run)


def _measure_frames(
    phantom: PhantomInput, on_frame: Callable[[int], None], *, is_live: bool
) -> tuple[list[TimedFrame], ProposedReference | None]:
    """Measure every frame, from the reference that is proposed on: as in a session, the mean of the ends of exhale.

    A recording trains inline and uses the thread's processor time, so it is reproducible.
    """
    clock = MonotonicClock() if is_live else ManualClock()
    pipeline = Pipeline(phantom.calibration, phantom.settings, clock, None if is_live else InlineTrainer())
    now_ns = time.monotonic_ns if is_live else time.thread_time_ns
    frames: list[TimedFrame] = []
    proposed, exhales = None, 0
    for frame in time_frames(frames_of(phantom.source, phantom.seconds), pipeline, now_ns):
        frames.append(_without_surface(frame))
        on_frame(len(frames))
        if proposed is not None:
            continue
        if exhales and frame.measurement.motion is not None:
            proposed = ProposedReference(at_us=frame.measurement.timestamp_us, exhales=exhales)
        else:
            exhales = _set_proposed(pipeline.learner)
    return frames, proposed


def _set_proposed(learner: Learner) -> int:
    """Have the proposed end of exhale become the reference; return of how many it is the mean, 0 for none yet."""
    proposals = learner.status.reference_proposals
    one = next((one for one in proposals if one.moment is ReferenceMoment.END_EXHALE), None)
    if one is None:
        return 0
    learner.set_reference(ReferenceMoment.END_EXHALE)
    return one.breaths


def _without_surface(frame: TimedFrame) -> TimedFrame:
    """Drop the surface mesh, which QA does not use: ten minutes of it take hundreds of megabytes."""
    motion = frame.measurement.motion
    if motion is None:
        return frame
    without = replace(motion, surface_mm=frozen(np.empty((0, 3))))
    return replace(frame, measurement=replace(frame.measurement, motion=without))


def run_of(
    phantom: PhantomInput,
    frames: Sequence[TimedFrame],
    *,
    is_live: bool = False,
    proposed: ProposedReference | None = None,
) -> PhantomRun | str:
    """Gate measured frames and convert all times to the trace's clock; the reason where there is nothing to gate.

    Frames before the proposed reference are left out; without one, the first measured frame is the reference.
    """
    from_us, exhales = (0, 0) if proposed is None else proposed
    measuring = [
        frame.measurement
        for frame in frames
        if frame.measurement.state is MeasurementState.MEASURING and frame.measurement.timestamp_us >= from_us
    ]
    if not measuring:
        return _why_unmeasured(frames)
    starts_us = frames[0].measurement.timestamp_us if phantom.starts_us is None else phantom.starts_us
    late_us = phantom.limits.camera_latency_ms * US_PER_MS

    def trace_time_s(at_us: float) -> float:
        return (at_us + late_us - starts_us) * 1e-6

    reference_us = measuring[0].timestamp_us
    after = [frame for frame in frames if frame.measurement.timestamp_us >= reference_us]
    time_s = np.array([trace_time_s(frame.timestamp_us) for frame in measuring])
    measured_mm = np.array([math.nan if frame.motion is None else frame.motion.whole_mm for frame in measuring])
    agreement = compare_motion(time_s, measured_mm, phantom.trace, time_s[0], exhales)
    lag_s = 0.0 if isinstance(agreement, str) else agreement.lag_s
    reference_mm = commanded_zero_mm(phantom.trace, float(time_s[0]) - lag_s, exhales)
    if not math.isfinite(reference_mm):
        return f"the reference was set at {time_s[0]:.1f} s, outside of the commanded trace"
    lower, upper = (edge - reference_mm for edge in phantom.window_mm)
    limits = replace(phantom.limits, window=AmplitudeWindow(lower=lower, upper=upper))
    edges = gate_edges(limits, frames, reference_us, "QA", is_live=is_live)
    intervals = joined(edges)
    dwells_us = _dwells_us(phantom, [on for on, _ in intervals], after)
    return PhantomRun(
        time_s=time_s,
        measured_mm=measured_mm,
        reference_mm=reference_mm,
        agreement=agreement,
        lost_share=1.0 - len(measuring) / len(after),
        intervals_s=tuple((trace_time_s(on.at_us), trace_time_s(off.at_us)) for on, off in intervals),
        undwelt_s=tuple(
            (trace_time_s(on.at_us - dwell_us), trace_time_s(off.at_us))
            for (on, off), dwell_us in zip(intervals, dwells_us, strict=True)
        ),
        dwell_s=float(np.mean(dwells_us)) * 1e-6 if len(dwells_us) else 0.0,
        ends_s=trace_time_s(frames[-1].measurement.timestamp_us),
        still_on_s=trace_time_s(edges[-1].at_us) if edges and edges[-1].is_on else None,
    )


def _dwells_us(phantom: PhantomInput, switched_on: Sequence[Edge], frames: Sequence[TimedFrame]) -> list[float]:
    """Dwell of each interval [us], bounded to the configured dwell up to one frame more."""
    stamps_us = np.array([frame.measurement.timestamp_us for frame in frames], dtype=np.float64)
    frame_us = float(np.median(np.diff(stamps_us))) if len(stamps_us) > 1 else 0.0
    least_us = max(phantom.limits.dwell_ms * US_PER_MS, (phantom.limits.min_good_frames - 1) * frame_us)
    return [min(max(edge.dwelt_us or 0.0, least_us), least_us + frame_us) for edge in switched_on]


def _why_unmeasured(frames: Sequence[TimedFrame]) -> str:
    if not frames:
        return "the recording is empty"
    last = frames[-1].measurement
    if last.lost is not None:
        return f"nothing was measured: {last.lost.reason.value}: {last.lost.detail}"
    note = "" if last.training is None else last.training.note
    return f"{len(frames)} frames were not enough to learn a motion model. {note}".strip()


def figures_of(phantom: PhantomInput, run: PhantomRun) -> list[QaFigure]:
    """Return the figures of motion and gate timing."""
    lost = QaFigure(code="motion_lost_percent", value=100.0 * run.lost_share)
    return [*_motion_figures(run.agreement), lost, *_gate_figures(phantom, run)]


def _motion_figures(found: MotionAgreement | str) -> list[QaFigure]:
    if isinstance(found, str):
        return [QaFigure(code=code, value=None, detail=found) for code in MOTION_CODES]
    values = (found.offset_mm, found.mean_error_mm, found.p95_error_mm, found.ratio, MS_PER_S * found.lag_s)
    detail = f"{found.frames} frames"
    return [QaFigure(code=code, value=value, detail=detail) for code, value in zip(MOTION_CODES, values, strict=True)]


def _timing(phantom: PhantomInput, run: PhantomRun) -> GateTiming | str:
    cycles = find_cycles(phantom.trace, phantom.window_mm, float(run.time_s[0]), run.ends_s)
    return time_gate_by_sines(cycles, run.undwelt_s)


def _gate_figures(phantom: PhantomInput, run: PhantomRun) -> list[QaFigure]:
    found = _timing(phantom, run)
    if isinstance(found, str):
        return [QaFigure(code=code, value=None, detail=found) for code in GATE_CODES]
    periods = [cycle.period_s for cycle, _ in found.pairs]
    detail = (
        f"{found.cycles} cycles of {min(periods):.1f} to {max(periods):.1f} s, dwell {MS_PER_S * run.dwell_s:.0f} ms"
    )
    if not found.has_periods:
        detail += "; one period only, so the difference includes an error of the level"
    return [
        _in_ms("gate_mean_delay_ms", found.mean_s, detail),
        _in_ms("gate_delay_difference_ms", found.difference_s, detail),
        _in_ms("gate_delay_on_ms", found.on_s, detail),
        _in_ms("gate_delay_off_ms", found.off_s, detail),
        _outside(phantom, run),
        QaFigure(code="duty_cycle_change_percent", value=100.0 * found.duty_change, detail=detail),
    ]


def _outside(phantom: PhantomInput, run: PhantomRun) -> QaFigure:
    """Longest beam-on time outside of the window, over all intervals [ms]."""
    outside_s = longest_outside_s(phantom.trace, phantom.window_mm, run.beam_on_s, float(run.time_s[0]), run.ends_s)
    value = None if outside_s is None else MS_PER_S * outside_s
    return QaFigure(code="beam_outside_ms", value=value, detail=f"of {len(run.beam_on_s)} beam-on intervals")


def _in_ms(code: str, estimate: Estimate, detail: str) -> QaFigure:
    return QaFigure(code=code, value=MS_PER_S * estimate.value, detail=detail, uncertainty=MS_PER_S * estimate.error)


def series_of(phantom: PhantomInput, run: PhantomRun) -> list[QaSeries]:
    """Return the plots: commanded and measured motion, and where the sines were timed, the gate's intervals."""
    found = _timing(phantom, run)
    return [_motion_series(phantom, run), *([] if isinstance(found, str) else _gate_series(found, run))]


def _motion_series(phantom: PhantomInput, run: PhantomRun) -> QaSeries:
    commanded_mm = phantom.trace.at(run.time_s) - run.reference_mm
    return QaSeries(
        code="commanded_measured",
        title="Commanded and measured motion",
        x_label="time, s",
        y_label="motion from the reference, mm",
        curves=(_curve("commanded", run.time_s, commanded_mm), _curve("measured", run.time_s, run.measured_mm)),
    )


def _gate_series(found: GateTiming, run: PhantomRun) -> list[QaSeries]:
    with_dwell = dict(zip(run.undwelt_s, run.intervals_s, strict=True))
    number = np.arange(1.0, len(found.pairs) + 1.0)
    period = np.array([cycle.period_s for cycle, _ in found.pairs])
    middle = np.array([cycle.middle_s for cycle, _ in found.pairs])
    sine = np.array([(cycle.on_s, cycle.off_s) for cycle, _ in found.pairs])
    beam = np.array([with_dwell[pair] for _, pair in found.pairs])
    phases = QaSeries(
        code="gate_intervals",
        title="Beam on, around each sine's turning point",
        x_label="cycle",
        y_label="time from the turning point, ms",
        curves=(
            _curve("enters the window", number, MS_PER_S * (sine[:, 0] - middle)),
            _curve("leaves the window", number, MS_PER_S * (sine[:, 1] - middle)),
            _curve("beam on", number, MS_PER_S * (beam[:, 0] - middle)),
            _curve("beam off", number, MS_PER_S * (beam[:, 1] - middle)),
        ),
    )
    lengths = QaSeries(
        code="gate_lengths",
        title="Length of beam on against the sine's period",
        x_label="period, s",
        y_label="length, s",
        curves=(
            _curve("inside the window", period, sine[:, 1] - sine[:, 0]),
            _curve("beam on", period, beam[:, 1] - beam[:, 0]),
        ),
    )
    return [phases, lengths]


def joined(edges: Sequence[Edge]) -> list[tuple[Edge, Edge]]:
    """Pair edges as (on, off); an interval that is open at the end is left out."""
    return [(first, second) for first, second in pairwise(edges) if first.is_on and not second.is_on]


def _curve(name: str, x: Grid, y: Grid) -> QaCurve:
    """Drop points that are not finite and thin the curve evenly to at most `MAX_POINTS`."""
    kept = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    kept = kept[:: max(math.ceil(len(kept) / MAX_POINTS), 1)]
    return QaCurve(name=name, x=tuple(x[kept].tolist()), y=tuple(y[kept].tolist()))
