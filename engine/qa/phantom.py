"""What a moving phantom tells: how true the measured motion is, and how late the gate.

The phantom is measured and gated by the very pipeline and gate that treat. A decision comes its own computing time
after the frame came: of a live camera later by as much as it came later than the promptest frame; a recording does not
tell, and its frames come as they are captured. The camera's own delay, where the site has measured one, is before both.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from engine.clock import ManualClock, MonotonicClock
from engine.errors import TidegateError
from engine.frames import MeasurementState, frozen
from engine.pipeline import Pipeline
from engine.qa.inputs import PhantomInput
from engine.qa.motion import MotionAgreement, compare_motion
from engine.qa.outside import longest_outside_s
from engine.qa.playing import frames_of, opened
from engine.qa.results import QaCurve, QaFigure, QaNeed, QaSeries
from engine.qa.sine import Estimate, GateTiming, find_cycles, time_gate_by_sines
from engine.qa.unmeasured import not_measured
from engine.timed_gate import Edge, TimedFrame, gate_edges, time_frames
from engine.training import InlineTrainer
from engine.windows import AmplitudeWindow

Grid = npt.NDArray[np.float64]
MS_PER_S = 1e3
US_PER_MS = 1e3
MOST_POINTS = 1500
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhantomRun:
    """A phantom, measured and gated, on the trace's clock.

    Attributes
    ----------
    time_s, measured_mm
        Of the measured frames, shape (n,).
    zero_mm
        Where the phantom was told to be when the zero was taken, at the first of these times; the lag undone.
    agreement
        How measured and commanded motion agree, or why that cannot be told.
    lost_share
        Share of the frames after the zero that gave no motion.
    intervals_s
        When the beam was on.
    undwelt_s
        When it would have been on without the dwell.
    still_on_s
        When it went on and had not gone off when the last frame was taken; None where it had.
    dwell_s
        How long the gate dwelt before it went on, the mean: as told, and a part of a frame more.
    ends_s
        When the last frame was taken.
    """

    time_s: Grid
    measured_mm: Grid
    zero_mm: float
    agreement: MotionAgreement | str
    lost_share: float
    intervals_s: tuple[tuple[float, float], ...]
    undwelt_s: tuple[tuple[float, float], ...]
    dwell_s: float
    ends_s: float
    still_on_s: float | None = None

    @property
    def lit_s(self) -> tuple[tuple[float, float], ...]:
        """When the beam was on, the last time too, which had no end yet."""
        return self.intervals_s if self.still_on_s is None else (*self.intervals_s, (self.still_on_s, self.ends_s))


def measure_phantom(given: PhantomInput, on_frame: Callable[[int], None]) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure and gate the phantom and say what it tells; what cannot be measured fails every check of it."""
    try:
        with opened(given.source) as description:
            seen = _watch(given, on_frame, is_live=description.is_live)
    except TidegateError as error:
        return not_measured(QaNeed.PHANTOM, str(error)), []
    run = run_of(given, seen, is_live=description.is_live)
    if isinstance(run, str):
        return not_measured(QaNeed.PHANTOM, run), []
    return figures_of(given, run), series_of(given, run)


def _watch(given: PhantomInput, on_frame: Callable[[int], None], *, is_live: bool) -> list[TimedFrame]:
    """Measure every frame. A recording learns in line and by the processor's time, so that it tells the same again."""
    clock = MonotonicClock() if is_live else ManualClock()
    pipeline = Pipeline(given.calibration, given.settings, clock, None if is_live else InlineTrainer())
    now_ns = time.monotonic_ns if is_live else time.thread_time_ns
    seen = []
    for frame in time_frames(frames_of(given.source, given.seconds), pipeline, now_ns):
        seen.append(_light(frame))
        on_frame(len(seen))
    return seen


def _light(frame: TimedFrame) -> TimedFrame:
    """Leave out the surface, which nobody asks for here: ten minutes of it are hundreds of megabytes."""
    motion = frame.measurement.motion
    if motion is None:
        return frame
    without = replace(motion, surface_mm=frozen(np.empty((0, 3))))
    return replace(frame, measurement=replace(frame.measurement, motion=without))


def run_of(given: PhantomInput, seen: Sequence[TimedFrame], *, is_live: bool = False) -> PhantomRun | str:
    """Gate measured frames, and put everything on the trace's clock; a sentence where there is nothing to gate."""
    measuring = [frame.measurement for frame in seen if frame.measurement.state is MeasurementState.MEASURING]
    if not measuring:
        return _why_unmeasured(seen)
    starts_us = seen[0].measurement.timestamp_us if given.starts_us is None else given.starts_us
    late_us = given.limits.camera_latency_ms * US_PER_MS

    def on_its_clock(at_us: float) -> float:
        return (at_us + late_us - starts_us) * 1e-6

    zero_us = measuring[0].timestamp_us
    after = [frame for frame in seen if frame.measurement.timestamp_us >= zero_us]
    time_s = np.array([on_its_clock(frame.timestamp_us) for frame in measuring])
    measured_mm = np.array([math.nan if frame.motion is None else frame.motion.whole_mm for frame in measuring])
    agreement = compare_motion(time_s, measured_mm, given.trace, time_s[0])
    lag_s = 0.0 if isinstance(agreement, str) else agreement.lag_s
    zero_mm = float(given.trace.at(time_s[:1] - lag_s)[0])
    if not math.isfinite(zero_mm):
        return f"the zero was taken at {time_s[0]:.1f} s, outside of the commanded trace"
    lower, upper = (edge - zero_mm for edge in given.window_mm)
    limits = replace(given.limits, window=AmplitudeWindow(lower=lower, upper=upper))
    edges = gate_edges(limits, seen, zero_us, "QA", is_live=is_live)
    intervals = joined(edges)
    dwells_us = _dwells_us(given, [on for on, _ in intervals], after)
    return PhantomRun(
        time_s=time_s,
        measured_mm=measured_mm,
        zero_mm=zero_mm,
        agreement=agreement,
        lost_share=1.0 - len(measuring) / len(after),
        intervals_s=tuple((on_its_clock(on.at_us), on_its_clock(off.at_us)) for on, off in intervals),
        undwelt_s=tuple(
            (on_its_clock(on.at_us - dwell_us), on_its_clock(off.at_us))
            for (on, off), dwell_us in zip(intervals, dwells_us, strict=True)
        ),
        dwell_s=float(np.mean(dwells_us)) * 1e-6 if len(dwells_us) else 0.0,
        ends_s=on_its_clock(seen[-1].measurement.timestamp_us),
        still_on_s=on_its_clock(edges[-1].at_us) if edges and edges[-1].is_on else None,
    )


def _dwells_us(given: PhantomInput, switched_on: Sequence[Edge], frames: Sequence[TimedFrame]) -> list[float]:
    """How long the gate dwelt each time [us]: not less than it was told to, nor over a frame more, whatever it did."""
    stamps_us = np.array([frame.measurement.timestamp_us for frame in frames], dtype=np.float64)
    frame_us = float(np.median(np.diff(stamps_us))) if len(stamps_us) > 1 else 0.0
    least_us = max(given.limits.dwell_ms * US_PER_MS, (given.limits.min_good_frames - 1) * frame_us)
    return [min(max(edge.dwelt_us or 0.0, least_us), least_us + frame_us) for edge in switched_on]


def _why_unmeasured(seen: Sequence[TimedFrame]) -> str:
    if not seen:
        return "the recording is empty"
    last = seen[-1].measurement
    if last.lost is not None:
        return f"nothing was measured: {last.lost.reason.value}: {last.lost.detail}"
    note = "" if last.training is None else last.training.note
    return f"{len(seen)} frames were not enough to learn a motion model. {note}".strip()


def figures_of(given: PhantomInput, run: PhantomRun) -> list[QaFigure]:
    """Say what a run tells."""
    lost = QaFigure(code="motion_lost_percent", value=100.0 * run.lost_share)
    return [*_motion_figures(run.agreement), lost, *_gate_figures(given, run)]


def _motion_figures(found: MotionAgreement | str) -> list[QaFigure]:
    if isinstance(found, str):
        return [QaFigure(code=code, value=None, detail=found) for code in MOTION_CODES]
    values = (found.offset_mm, found.mean_error_mm, found.p95_error_mm, found.ratio, MS_PER_S * found.lag_s)
    detail = f"{found.frames} frames"
    return [QaFigure(code=code, value=value, detail=detail) for code, value in zip(MOTION_CODES, values, strict=True)]


def _timing(given: PhantomInput, run: PhantomRun) -> GateTiming | str:
    cycles = find_cycles(given.trace, given.window_mm, float(run.time_s[0]), run.ends_s)
    return time_gate_by_sines(cycles, run.undwelt_s)


def _gate_figures(given: PhantomInput, run: PhantomRun) -> list[QaFigure]:
    found = _timing(given, run)
    if isinstance(found, str):
        return [QaFigure(code=code, value=None, detail=found) for code in GATE_CODES]
    periods = [cycle.period_s for cycle, _ in found.pairs]
    detail = (
        f"{found.cycles} cycles of {min(periods):.1f} to {max(periods):.1f} s, dwell {MS_PER_S * run.dwell_s:.0f} ms"
    )
    if not found.has_periods:
        detail += "; of one period, so that an error of the level is in the difference"
    return [
        _in_ms("gate_mean_delay_ms", found.mean_s, detail),
        _in_ms("gate_delay_difference_ms", found.difference_s, detail),
        _in_ms("gate_delay_on_ms", found.on_s, detail),
        _in_ms("gate_delay_off_ms", found.off_s, detail),
        _outside(given, run),
        QaFigure(code="duty_cycle_change_percent", value=100.0 * found.duty_change, detail=detail),
    ]


def _outside(given: PhantomInput, run: PhantomRun) -> QaFigure:
    """Tell the longest that the beam was on outside of the window, of every time it was on."""
    outside_s = longest_outside_s(given.trace, given.window_mm, run.lit_s, float(run.time_s[0]), run.ends_s)
    value = None if outside_s is None else MS_PER_S * outside_s
    return QaFigure(code="beam_outside_ms", value=value, detail=f"of {len(run.lit_s)} times the beam was on")


def _in_ms(code: str, estimate: Estimate, detail: str) -> QaFigure:
    return QaFigure(code=code, value=MS_PER_S * estimate.value, detail=detail, uncertainty=MS_PER_S * estimate.error)


def series_of(given: PhantomInput, run: PhantomRun) -> list[QaSeries]:
    """Return what to draw of a run."""
    found = _timing(given, run)
    return [_motion_series(given, run), *([] if isinstance(found, str) else _gate_series(found, run))]


def _motion_series(given: PhantomInput, run: PhantomRun) -> QaSeries:
    commanded_mm = given.trace.at(run.time_s) - run.zero_mm
    return QaSeries(
        code="commanded_measured",
        title="Commanded and measured motion",
        x_label="time, s",
        y_label="motion from the zero, mm",
        curves=(_curve("commanded", run.time_s, commanded_mm), _curve("measured", run.time_s, run.measured_mm)),
    )


def _gate_series(found: GateTiming, run: PhantomRun) -> list[QaSeries]:
    as_it_was = dict(zip(run.undwelt_s, run.intervals_s, strict=True))
    number = np.arange(1.0, len(found.pairs) + 1.0)
    period = np.array([cycle.period_s for cycle, _ in found.pairs])
    middle = np.array([cycle.middle_s for cycle, _ in found.pairs])
    sine = np.array([(cycle.on_s, cycle.off_s) for cycle, _ in found.pairs])
    beam = np.array([as_it_was[pair] for _, pair in found.pairs])
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
    """Join edges into (on, off); a beam that had not gone off at the end is left out."""
    return [(first, second) for first, second in pairwise(edges) if first.is_on and not second.is_on]


def _curve(name: str, x: Grid, y: Grid) -> QaCurve:
    """Thin a curve evenly to what a plot shows, and leave out what is not known."""
    kept = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    kept = kept[:: max(math.ceil(len(kept) / MOST_POINTS), 1)]
    return QaCurve(name=name, x=tuple(x[kept].tolist()), y=tuple(y[kept].tolist()))
