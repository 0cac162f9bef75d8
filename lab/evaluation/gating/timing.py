"""Timing of the gate's edges against the truth, on virtual volunteers whose motion is known.

One recording is measured once, and every window decides on the same frames as in a session: the decision on a frame
comes its computing time after its capture (processor time, which does not depend on the machine's load). The true edges
come from the same windows on the true motion at 1 kHz, without noise, frames or computing. With a frame every 33 ms, no
smaller delay can be guaranteed at that rate.

True breathing phase, known in retrospect: 0 % at every end of inhale, linear in time to the next.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks

from engine.calibration.camera_calibration import load_calibration
from engine.capture.recording_source import OniFileSource
from engine.core.breath import WHOLE, Breath, SignalChoice
from engine.core.clock import ManualClock
from engine.core.frames import FloatArray, MeasurementState, Motion
from engine.core.native_process import keep_calls_in_their_thread
from engine.core.signals import HeadDirection, Ranges
from engine.gating.limits import GateLimits
from engine.gating.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    ConditionState,
    GateWindow,
    JoinedWindow,
    PhaseWindow,
    WindowInput,
    breath_depths,
    initial_states,
)
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.offline_gate import Edge, TimedFrame, gate_edges, time_frames
from lab.evaluation.playback import decoded_frames
from lab.evaluation.runs.datasets import Run, make_dataset
from lab.phantom.truth import CELL_PX, POINTS_RC, Truth, load_truth

SHORTEST_BREATH_S = 1.5
PROMINENCE_SHARE = 0.4
DWELL_MS = 165.0
"""Just under five frames at 30 frames/s, so that counting in frames adds no delay; settling times likewise."""
STEP_US = 1_000
MATCH_MS = 400.0
REGION = (21, 9)
POINT = 2
WARM_UP_US = 12_000_000
"""Time to find the phase before any edge is evaluated [us]."""
_THORAX, _ABDOMEN = SignalChoice(signal="thorax"), SignalChoice(signal="abdomen")
_CELL = SignalChoice(signal="region", row=REGION[0], column=REGION[1])
_POINT = SignalChoice(signal="point", row=int(POINTS_RC[POINT][0]), column=int(POINTS_RC[POINT][1]), index=POINT)
_VOLUME = SignalChoice(signal="volume")


def true_phase_percent(motion: FloatArray, seconds: FloatArray) -> FloatArray:
    """Return the phase [%], 0 to below 100, shape (n,); NaN before the first end of inhale and after the last.

    Parameters
    ----------
    motion
        The true signal, inhale positive, without noise, shape (n,).
    seconds
        Its times [s], evenly spaced, shape (n,).
    """
    step_s = float(seconds[1] - seconds[0])
    prominence = PROMINENCE_SHARE * float(np.ptp(np.percentile(motion, [5.0, 95.0])))
    peaks, _ = find_peaks(motion, distance=max(int(SHORTEST_BREATH_S / step_s), 1), prominence=prominence)
    phase = np.full(len(motion), np.nan)
    for start, end in pairwise(peaks.tolist()):
        phase[start:end] = 100.0 * np.arange(end - start) / (end - start)
    return phase


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowKind:
    """An evaluated window, in per cent of the learned range, and its scenario."""

    name: str
    window: GateWindow
    scenario: str = "regular"


def _percent(lower: float, upper: float, choice: SignalChoice = WHOLE, hysteresis: float = 0.0) -> AmplitudeWindow:
    return AmplitudeWindow(choice=choice, lower=lower, upper=upper, hysteresis=hysteresis, unit="percent")


KINDS = (
    WindowKind(name="exhale, whole", window=_percent(-60.0, 35.0)),
    WindowKind(name="exhale, whole, hysteresis 5 %", window=_percent(-60.0, 35.0, hysteresis=5.0)),
    WindowKind(name="inhale, whole", window=_percent(60.0, 180.0)),
    WindowKind(name="between, whole", window=_percent(25.0, 85.0)),
    WindowKind(name="exhale, thorax", window=_percent(-60.0, 35.0, _THORAX)),
    WindowKind(name="exhale, abdomen", window=_percent(-60.0, 35.0, _ABDOMEN)),
    WindowKind(name="exhale, a region of 10 x 10 px", window=_percent(-60.0, 35.0, _CELL)),
    WindowKind(name="exhale, a point", window=_percent(-60.0, 35.0, _POINT)),
    WindowKind(name="exhale, volume", window=_percent(-60.0, 35.0, _VOLUME)),
    WindowKind(
        name="thorax AND abdomen",
        window=JoinedWindow(conditions=(_percent(-60.0, 35.0, _THORAX), _percent(-60.0, 40.0, _ABDOMEN))),
    ),
    WindowKind(
        name="thorax OR abdomen",
        window=JoinedWindow(conditions=(_percent(-60.0, 35.0, _THORAX), _percent(-60.0, 40.0, _ABDOMEN)), join="or"),
    ),
    WindowKind(
        name="breath hold, expiration",
        window=BreathHoldWindow(
            level=_percent(-60.0, 35.0), kind="expiration", settle_ms=290.0, still=2.0, max_drift=3.0, timeout_s=20.0
        ),
    ),
    WindowKind(
        name="breath hold, inspiration",
        window=BreathHoldWindow(
            level=_percent(150.0, 300.0), settle_ms=990.0, still=2.0, max_drift=3.0, timeout_s=25.0
        ),
        scenario="dibh",
    ),
    WindowKind(name="phase 30 to 70 %", window=PhaseWindow(from_percent=30.0, to_percent=70.0)),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeTiming:
    """Edges of one window and one direction on one recording against the true edges.

    Attributes
    ----------
    delays_ms
        Delays of the matched edges, positive is late [ms].
    missed, extra
        Number of true edges without a decision, and of decisions without a true edge.
    beyond
        Distance of the true signal from the window at beam off [mm; l for the volume]; empty for beam on.
    """

    kind: str
    run: str
    is_on: bool
    delays_ms: FloatArray
    missed: int
    extra: int
    beyond: FloatArray


def plan(seed: int, seconds: float) -> list[Run]:
    """Return the recordings: regular breathing of three volunteers, breath holds of two."""
    scenarios = [("regular", volunteer) for volunteer in (1, 4, 10)] + [("dibh", volunteer) for volunteer in (1, 4)]
    return [
        Run(
            name=f"G{number:02d}",
            group="gate",
            scenario=scenario,
            volunteer=volunteer,
            seed=seed + 300 + number,
            seconds=seconds,
        )
        for number, (scenario, volunteer) in enumerate(scenarios, start=1)
    ]


def time_gate(run: Run, folder: Path, on_done: Callable[[int], None]) -> list[EdgeTiming]:
    """Make a run's recording if it is missing, measure it, and compare every window's edges with the true ones.

    Parameters
    ----------
    on_done
        Called with the number of frames done so far; each frame counts once made and once measured.
    """
    keep_calls_in_their_thread()
    make_dataset(run, folder, lambda done, _total: on_done(done))
    truth = load_truth(folder / "truth.npz")
    pipeline, seen = _measure_recording(folder, lambda done: on_done(run.frames + done))
    choices = [choice for kind in KINDS for choice in kind.window.choices]
    ranges = pipeline.learner.learned_ranges(choices)
    first = next(frame.measurement for frame in seen if frame.measurement.state is MeasurementState.MEASURING)
    true = _TrueMotion(truth, first.timestamp_us)
    found = []
    for kind in KINDS:
        if kind.scenario == run.scenario:
            window = kind.window.resolved(ranges)
            from_us = first.timestamp_us + WARM_UP_US
            found += _compare(
                kind.name, run, _real_edges(window, seen, from_us, ranges), true.edges(window, from_us), window, true
            )
    return found


def _measure_recording(folder: Path, on_frame: Callable[[int], None]) -> tuple[Pipeline, list[TimedFrame]]:
    """Measure a recording, with each frame's processor time."""
    points = tuple((int(row), int(column)) for row, column in POINTS_RC)
    settings = PipelineSettings(cell_px=CELL_PX, points=points, superior_px=HeadDirection.TOP.superior_px)
    pipeline = Pipeline(load_calibration(folder / "calibration.json"), settings, ManualClock(), InlineTrainer())
    source = OniFileSource(folder / "recording.oni", clock=ManualClock(), is_helped=False)
    seen = []
    for frame in time_frames(decoded_frames(source), pipeline):
        seen.append(frame)
        on_frame(frame.measurement.frame_index + 1)
    return pipeline, seen


def _real_edges(window: GateWindow, seen: Sequence[TimedFrame], from_us: int, ranges: Ranges) -> list[Edge]:
    """Edges of a gate on measured frames that are received when they are captured."""
    limits = GateLimits(
        window=window,
        dwell_ms=DWELL_MS,
        min_good_frames=2,
        head_direction=HeadDirection.TOP,
        breath_depths=breath_depths(ranges),
        is_played=True,
    )
    return gate_edges(limits, seen, from_us, "evaluation")


class _TrueMotion:
    """The true motion as window inputs at 1 kHz; only the signals that the windows use."""

    def __init__(self, truth: Truth, reference_us: int) -> None:
        seconds = truth.timestamp_us * 1e-6
        self.first_us, self.last_us = int(truth.timestamp_us[0]), int(truth.timestamp_us[-1])
        depths = np.column_stack(
            [
                truth.whole_depth_mm,
                truth.thorax_depth_mm,
                truth.abdomen_depth_mm,
                truth.cell_depth_mm[:, REGION[0], REGION[1]],
                truth.point_depth_mm,
            ]
        ).astype(np.float64)
        reference_s = reference_us * 1e-6
        depth, volume = CubicSpline(seconds, depths), CubicSpline(seconds, truth.volume_l)
        self.times_us = np.arange(self.first_us, self.last_us, STEP_US)
        grid_s = self.times_us * 1e-6
        self._motion_mm = depth(reference_s) - depth(grid_s)
        self._volume_l = volume(grid_s) - volume(reference_s)
        self._phase = true_phase_percent(self._motion_mm[:, 0], grid_s)

    def window_inputs(self) -> Iterator[WindowInput]:
        """Yield the window input of each step."""
        cells = np.full((REGION[0] + 1, REGION[1] + 1), np.nan)
        for number, at_us in enumerate(self.times_us.tolist()):
            yield self._window_input(number, at_us, cells)

    def signal(self, choice: SignalChoice, at_us: float) -> float:
        """Return a signal at a time [mm; l for the volume]."""
        number = min(max(round((at_us - self.first_us) / STEP_US), 0), len(self.times_us) - 1)
        cells = np.full((REGION[0] + 1, REGION[1] + 1), np.nan)
        return choice.value_in(self._window_input(number, int(at_us), cells).motion)

    def _window_input(self, number: int, at_us: int, cells: FloatArray) -> WindowInput:
        whole, thorax, abdomen, cell, *points = self._motion_mm[number].tolist()
        cells[REGION] = cell
        motion = _TrueSignals(whole, thorax, abdomen, float(self._volume_l[number]), cells, np.array(points))
        phase = float(self._phase[number])
        breath = Breath(phase_percent=phase if np.isfinite(phase) else None, phase_confidence=1.0)
        return WindowInput(cast("Motion", motion), (breath,), at_us)

    def edges(self, window: GateWindow, from_us: int) -> list[Edge]:
        """Edges of an ideal gate, a window and a dwell, on the truth at 1 kHz."""
        states: tuple[ConditionState, ...] = initial_states(window)
        edges: list[Edge] = []
        inside_since_us: int | None = None
        is_on = False
        for window_input in self.window_inputs():
            if window_input.timestamp_us < from_us:
                continue
            verdict = window.judge(window_input, states)
            states = verdict.states
            inside_since_us = (inside_since_us or window_input.timestamp_us) if verdict.is_inside else None
            dwelt_us = -1 if inside_since_us is None else window_input.timestamp_us - inside_since_us
            now_on = dwelt_us >= DWELL_MS * 1_000
            if now_on is not is_on:
                edges.append(Edge(at_us=float(window_input.timestamp_us), is_on=now_on))
            is_on = now_on
        return edges


@dataclass(frozen=True, slots=True)
class _TrueSignals:
    """The part of a `Motion` that windows use."""

    whole_mm: float
    thorax_mm: float
    abdomen_mm: float
    volume_l: float
    regions_mm: FloatArray
    points_mm: FloatArray


def _compare(
    name: str, run: Run, real: list[Edge], ideal: list[Edge], window: GateWindow, true: _TrueMotion
) -> list[EdgeTiming]:
    """Match the edges of each direction with the nearest true edge."""
    timings = []
    for is_on in (True, False):
        true_us = np.array([edge.at_us for edge in ideal if edge.is_on is is_on])
        decided_us = [edge.at_us for edge in real if edge.is_on is is_on]
        matches = [_match(at_us, true_us) for at_us in decided_us]
        delays = [(at_us - true_us[i]) * 1e-3 for at_us, i in zip(decided_us, matches, strict=True) if i is not None]
        timings.append(
            EdgeTiming(
                kind=name,
                run=run.name,
                is_on=is_on,
                delays_ms=np.array(delays),
                missed=len(true_us) - len({i for i in matches if i is not None}),
                extra=sum(i is None for i in matches),
                beyond=np.array([] if is_on else [_beyond(window, true, at_us) for at_us in decided_us]),
            )
        )
    return timings


def _match(at_us: float, true_us: FloatArray) -> int | None:
    if not len(true_us):
        return None
    nearest = int(np.argmin(np.abs(true_us - at_us)))
    return nearest if abs(true_us[nearest] - at_us) <= MATCH_MS * 1e3 else None


def _beyond(window: GateWindow, true: _TrueMotion, at_us: float) -> float:
    """Distance of the true signal from an amplitude window at a time; NaN for other windows."""
    if not isinstance(window, AmplitudeWindow):
        return float("nan")
    value = true.signal(window.choice, at_us)
    return max(window.lower - value, value - window.upper, 0.0)
