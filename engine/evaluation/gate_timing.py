"""When the beam goes on and off, against when it should: gate edges on virtual volunteers whose motion is known.

One recording is measured once, and every window decides on the same frames, as live: a frame is decided when it has
been measured, its own computing time after it was captured; the processor's, so that a busy machine tells the same.
The same windows decide on the true motion, a thousand times a second, without noise, frames or computing: that is when
the beam should have switched. A frame comes every 33 ms, so no camera at that rate can be sure to do better than that.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from scipy.interpolate import CubicSpline

from engine.breath import WHOLE, Breath, SignalChoice
from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import ManualClock
from engine.evaluation.datasets import Run, make_dataset
from engine.evaluation.playing import decoded_frames
from engine.evaluation.true_phase import true_phase_percent
from engine.frames import FloatArray, MeasurementState, Motion
from engine.limits import GateLimits
from engine.phantom.truth import CELL_PX, POINTS_RC, Truth, load_truth
from engine.pipeline import Pipeline, PipelineSettings
from engine.threads import keep_calls_in_their_thread
from engine.timed_gate import Edge, TimedFrame, gate_edges, time_frames
from engine.training import InlineTrainer
from engine.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    ConditionState,
    GateWindow,
    JoinedWindow,
    PhaseWindow,
    Sight,
    at_rest,
    signal_of,
)

DWELL_MS = 165.0
"""Just under five frames at 30 a second, so that counting in frames adds nothing; settling times likewise."""

STEP_US = 1_000
MATCH_MS = 400.0
REGION = (21, 9)
POINT = 2
WARM_UP_US = 12_000_000
"""Breaths the phase is found in before anything is judged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowKind:
    """A window to judge, told in per cent of the learned range, and the scenario it is judged on."""

    name: str
    window: GateWindow
    scenario: str = "regular"


def _percent(lower: float, upper: float, choice: SignalChoice = WHOLE, hysteresis: float = 0.0) -> AmplitudeWindow:
    return AmplitudeWindow(choice=choice, lower=lower, upper=upper, hysteresis=hysteresis, unit="percent")


_THORAX, _ABDOMEN = SignalChoice(signal="thorax"), SignalChoice(signal="abdomen")
_CELL = SignalChoice(signal="region", row=REGION[0], column=REGION[1])
_POINT = SignalChoice(signal="point", row=int(POINTS_RC[POINT][0]), column=int(POINTS_RC[POINT][1]), index=POINT)
_VOLUME = SignalChoice(signal="volume")

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
    """How the edges of one window on one recording compare with when they should have been.

    Attributes
    ----------
    delays_ms
        Of the edges that have a partner: positive is late.
    missed, extra
        Edges that should have been and were not, and the other way round.
    beyond
        How far the true signal was outside of the window when the beam went off [mm; l of the volume]; empty where the
        window has no such edge.
    """

    kind: str
    run: str
    is_on: bool
    delays_ms: FloatArray
    missed: int
    extra: int
    beyond: FloatArray


def plan(seed: int, seconds: float) -> list[Run]:
    """Plan the recordings: regular breathing of three volunteers, breath holds of two."""
    wanted = [("regular", volunteer) for volunteer in (1, 4, 10)] + [("dibh", volunteer) for volunteer in (1, 4)]
    return [
        Run(
            name=f"G{number:02d}",
            group="gate",
            scenario=scenario,
            volunteer=volunteer,
            seed=seed + 300 + number,
            seconds=seconds,
        )
        for number, (scenario, volunteer) in enumerate(wanted, start=1)
    ]


def time_gate(run: Run, folder: Path, on_done: Callable[[int], None]) -> list[EdgeTiming]:
    """Make a run's recording if it is not there, measure it, and compare every window's edges with the truth's.

    Parameters
    ----------
    on_done
        Called with the number of frames done so far: each is made, then measured.
    """
    keep_calls_in_their_thread()
    make_dataset(run, folder, lambda done, _total: on_done(done))
    truth = load_truth(folder / "truth.npz")
    pipeline, seen = _measured(folder, lambda done: on_done(run.frames + done))
    choices = [choice for kind in KINDS for choice in kind.window.choices]
    ranges = pipeline.learned_ranges(choices)
    first = next(frame.measurement for frame in seen if frame.measurement.state is MeasurementState.MEASURING)
    true = _TrueMotion(truth, first.timestamp_us)
    found = []
    for kind in KINDS:
        if kind.scenario == run.scenario:
            window = kind.window.resolved(ranges)
            from_us = first.timestamp_us + WARM_UP_US
            found += _compared(
                kind.name, run, _real_edges(window, seen, from_us), true.edges(window, from_us), window, true
            )
    return found


def _measured(folder: Path, on_frame: Callable[[int], None]) -> tuple[Pipeline, list[TimedFrame]]:
    """Measure a recording, and how long each frame took."""
    points = tuple((int(row), int(column)) for row, column in POINTS_RC)
    settings = PipelineSettings(cell_px=CELL_PX, points=points)
    pipeline = Pipeline(load_calibration(folder / "calibration.json"), settings, ManualClock(), InlineTrainer())
    source = OniFileSource(folder / "recording.oni", clock=ManualClock(), is_helped=False)
    seen = []
    for frame in time_frames(decoded_frames(source), pipeline):
        seen.append(frame)
        on_frame(frame.measurement.frame_index + 1)
    return pipeline, seen


def _real_edges(window: GateWindow, seen: Sequence[TimedFrame], from_us: int) -> list[Edge]:
    """Let a gate decide on measured frames that are received as they are captured."""
    limits = GateLimits(window=window, dwell_ms=DWELL_MS, min_good_frames=2, is_played=True)
    return gate_edges(limits, seen, from_us, "evaluation")


class _TrueMotion:
    """The true motion as a window sees it, at any time; only the signals the windows look at."""

    def __init__(self, truth: Truth, zero_us: int) -> None:
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
        zero_s = zero_us * 1e-6
        depth, volume = CubicSpline(seconds, depths), CubicSpline(seconds, truth.volume_l)
        self.times_us = np.arange(self.first_us, self.last_us, STEP_US)
        grid_s = self.times_us * 1e-6
        self._motion_mm = depth(zero_s) - depth(grid_s)
        self._volume_l = volume(grid_s) - volume(zero_s)
        self._phase = true_phase_percent(self._motion_mm[:, 0], grid_s)

    def sights(self) -> Iterator[Sight]:
        """Show the motion step by step."""
        cells = np.full((REGION[0] + 1, REGION[1] + 1), np.nan)
        for number, at_us in enumerate(self.times_us.tolist()):
            yield self._sight(number, at_us, cells)

    def signal(self, choice: SignalChoice, at_us: float) -> float:
        """Pick a signal at a time [mm; l of the volume]."""
        number = min(max(round((at_us - self.first_us) / STEP_US), 0), len(self.times_us) - 1)
        cells = np.full((REGION[0] + 1, REGION[1] + 1), np.nan)
        return signal_of(choice, self._sight(number, int(at_us), cells).motion)

    def _sight(self, number: int, at_us: int, cells: FloatArray) -> Sight:
        whole, thorax, abdomen, cell, *points = self._motion_mm[number].tolist()
        cells[REGION] = cell
        motion = _Truly(whole, thorax, abdomen, float(self._volume_l[number]), cells, np.array(points))
        phase = float(self._phase[number])
        breath = Breath(phase_percent=phase if np.isfinite(phase) else None, phase_confidence=1.0)
        return Sight(cast("Motion", motion), (breath,), at_us)

    def edges(self, window: GateWindow, from_us: int) -> list[Edge]:
        """Let an ideal gate decide: a window and a dwell, on every millisecond of the truth."""
        states: tuple[ConditionState, ...] = at_rest(window)
        edges: list[Edge] = []
        inside_since_us: int | None = None
        is_on = False
        for sight in self.sights():
            if sight.timestamp_us < from_us:
                continue
            verdict = window.judge(sight, states)
            states = verdict.states
            inside_since_us = (inside_since_us or sight.timestamp_us) if verdict.is_inside else None
            dwelt_us = -1 if inside_since_us is None else sight.timestamp_us - inside_since_us
            now_on = dwelt_us >= DWELL_MS * 1_000
            if now_on is not is_on:
                edges.append(Edge(at_us=float(sight.timestamp_us), is_on=now_on))
            is_on = now_on
        return edges


@dataclass(frozen=True, slots=True)
class _Truly:
    """As much of a :class:`Motion` as a window looks at."""

    whole_mm: float
    thorax_mm: float
    abdomen_mm: float
    volume_l: float
    regions_mm: FloatArray
    points_mm: FloatArray


def _compared(
    name: str, run: Run, real: list[Edge], ideal: list[Edge], window: GateWindow, true: _TrueMotion
) -> list[EdgeTiming]:
    """Pair the edges of each direction with the nearest that should have been."""
    timings = []
    for is_on in (True, False):
        wanted = np.array([edge.at_us for edge in ideal if edge.is_on is is_on])
        got = [edge.at_us for edge in real if edge.is_on is is_on]
        partners = [_partner(at_us, wanted) for at_us in got]
        delays = [(at_us - wanted[i]) * 1e-3 for at_us, i in zip(got, partners, strict=True) if i is not None]
        timings.append(
            EdgeTiming(
                kind=name,
                run=run.name,
                is_on=is_on,
                delays_ms=np.array(delays),
                missed=len(wanted) - len({i for i in partners if i is not None}),
                extra=sum(i is None for i in partners),
                beyond=np.array([] if is_on else [_beyond(window, true, at_us) for at_us in got]),
            )
        )
    return timings


def _partner(at_us: float, wanted: FloatArray) -> int | None:
    if not len(wanted):
        return None
    nearest = int(np.argmin(np.abs(wanted - at_us)))
    return nearest if abs(wanted[nearest] - at_us) <= MATCH_MS * 1e3 else None


def _beyond(window: GateWindow, true: _TrueMotion, at_us: float) -> float:
    """How far the truth is outside of the window at a time; NaN for windows without one edge to be beyond."""
    if not isinstance(window, AmplitudeWindow):
        return float("nan")
    value = true.signal(window.choice, at_us)
    return max(window.lower - value, value - window.upper, 0.0)
