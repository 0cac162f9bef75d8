"""Scenarios of a recording: breathing signals, movements on the couch, occlusions, and their labels.

Free breathing comes first, long enough to train a model (20 s); then the event that names the scenario.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError
from engine.qa.recorded_traces import Trace
from lab.phantom.breathing import IRREGULAR, REGULAR, Signals, breathe, time_grid
from lab.phantom.builds import Build
from lab.phantom.episodes import lay_out_course

Grid = npt.NDArray[np.float64]
FREE_S = 20.0
USUAL_S = 36.0
"""Regular breathing before the first event [s]: time to train a model and to learn the usual breath."""
# Shortest recording in which each scenario's event fits after the free breathing [s].
SHORTEST_S = {
    "regular": 2.0,
    "irregular": 2.0,
    "isovolume": 32.0,
    "dibh": 36.0,
    "drift": 10.0,
    "shift": 28.0,
    "occlusion": 36.0,
    "events": 60.0,
}
LONGEST_S = 1800.0
TRACE_SCENARIOS = ("regular", "drift", "shift", "occlusion")


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """A labelled event between two times [s]; ``detail`` holds its parameters."""

    name: str
    start_s: float
    end_s: float
    detail: dict[str, float] = field(default_factory=dict)

    def contains(self, time_s: float) -> bool:
        """Whether the event is active at this time."""
        return self.start_s <= time_s < self.end_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Position of the body on the couch relative to its first one: translation [mm], z down, and rotations [rad].

    ``turn_rad`` is about the vertical, ``tilt_rad`` about the axis across the body, ``roll_rad`` about its long axis.
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    turn_rad: float = 0.0
    z_mm: float = 0.0
    tilt_rad: float = 0.0
    roll_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Timeline:
    """Signals and events of a scenario over time."""

    signals: Signals
    events: tuple[Event, ...] = ()

    def event(self, name: str, time_s: float) -> Event | None:
        """Return the event of that name that is active at this time, if any."""
        return next((event for event in self.events if event.name == name and event.contains(time_s)), None)

    def pose(self, time_s: float) -> Pose:
        """Pose of the body at this time."""
        move = next((event for event in self.events if event.name == "shift"), None)
        if move is None or time_s <= move.start_s:
            return Pose()
        share = float(_smooth((time_s - move.start_s) / (move.end_s - move.start_s)))
        detail = move.detail
        return Pose(
            x_mm=share * detail["x_mm"], y_mm=share * detail["y_mm"], turn_rad=share * np.deg2rad(detail["turn_deg"])
        )


def plan(
    scenario: str, build: Build, seconds: float, rng: np.random.Generator, *, volume_ratio: float, trace: Trace | None
) -> Timeline:
    """Generate the timeline of a scenario.

    Parameters
    ----------
    volume_ratio
        Volume change per mm of the abdomen's signal over the volume change per mm of the thorax's.

    Raises
    ------
    InvalidValueError
        The scenario is unknown, or the recording's or the trace's length does not fit it.
    """
    check_scenario(scenario, seconds, trace)
    if trace is None:
        habit = IRREGULAR if scenario == "irregular" else REGULAR
        signals = breathe(build, habit, time_grid(seconds), rng)
    else:
        time_s = time_grid(seconds)
        motion = trace.at(time_s)
        signals = Signals(time_s=time_s, abdomen_mm=motion, thorax_mm=build.thorax_share * motion)
    timeline = Timeline(signals=signals, events=(Event(name="free", start_s=0.0, end_s=seconds),))
    match scenario:
        case "isovolume":
            timeline = _isovolume(signals, build, seconds, rng, volume_ratio)
        case "dibh":
            timeline = _dibh(signals, build, seconds, rng)
        case "drift":
            timeline = _drift(signals, seconds, rng)
        case "shift":
            timeline = _shift(signals, seconds, rng)
        case "occlusion":
            timeline = _occlusion(signals, seconds, rng)
        case "events":
            timeline = _events(build, seconds, rng)
    return timeline


def check_scenario(scenario: str, seconds: float, trace: Trace | None) -> None:
    """Raise InvalidValueError naming field, value and bound if scenario, length and trace do not fit."""
    if scenario not in SHORTEST_S:
        raise InvalidValueError("scenario", scenario, "one of " + ", ".join(SHORTEST_S))
    shortest = SHORTEST_S[scenario]
    if isinstance(seconds, bool) or not shortest <= seconds <= LONGEST_S:
        raise InvalidValueError("seconds", seconds, f"from {shortest:g} to {LONGEST_S:g} for {scenario}")
    if trace is None:
        return
    if scenario not in TRACE_SCENARIOS:
        raise InvalidValueError("scenario", scenario, "with a trace one of " + ", ".join(TRACE_SCENARIOS))
    if seconds > trace.seconds:
        raise InvalidValueError("seconds", seconds, f"at most {trace.seconds:.1f}, the length of the trace")


def _smooth(t: npt.ArrayLike) -> Grid:
    """From 0 at t = 0 to 1 at t = 1, flat at both ends."""
    clipped = np.clip(t, 0.0, 1.0)
    return np.asarray(clipped**3 * (clipped * (6.0 * clipped - 15.0) + 10.0))


def _between(time_s: Grid, start_s: float, end_s: float, ramp_s: float) -> Grid:
    """Weight that is 1 between two times and 0 elsewhere, with smooth ramps inside the span."""
    return _smooth((time_s - start_s) / ramp_s) * (1.0 - _smooth((time_s - end_s + ramp_s) / ramp_s))


def _isovolume(
    signals: Signals, build: Build, seconds: float, rng: np.random.Generator, volume_ratio: float
) -> Timeline:
    """Isovolume manoeuvre: with the glottis closed, abdomen and chest exchange volume and the sum stays constant."""
    start, end = max(FREE_S, 0.45 * seconds), seconds - 1.0
    inside = _between(signals.time_s, start, end, 1.5)
    period = float(rng.uniform(3.2, 4.2))
    turn = 2.0 * np.pi / period
    swing = np.sin(turn * (signals.time_s - start))
    # The chest's skin lags behind its signal; advance the signal so that both move at the same time.
    chest_swing = np.sin(turn * (signals.time_s - start + build.thorax_lag_s))
    # The chest's amplitude balances the volume; both are limited to that of a deep breath.
    abdomen = min(0.8 * build.amplitude_mm, 9.0 / max(volume_ratio, 1e-6))
    hold = 0.35
    abdomen_mm = hold * build.amplitude_mm + abdomen * swing
    thorax_mm = hold * build.amplitude_mm * build.thorax_share - volume_ratio * abdomen * chest_swing
    return Timeline(
        signals=replace(
            signals,
            abdomen_mm=signals.abdomen_mm * (1.0 - inside) + abdomen_mm * inside,
            thorax_mm=signals.thorax_mm * (1.0 - inside) + thorax_mm * inside,
        ),
        events=(
            Event(name="free", start_s=0.0, end_s=start),
            Event(name="isovolume", start_s=start + 1.5, end_s=end - 1.5, detail={"period_s": period}),
        ),
    )


def _dibh(signals: Signals, build: Build, seconds: float, rng: np.random.Generator) -> Timeline:
    """Deep inspiration breath holds, with a larger share of the chest than in free breathing."""
    abdomen_mm, thorax_mm = signals.abdomen_mm.copy(), signals.thorax_mm.copy()
    events = [Event(name="free", start_s=0.0, end_s=FREE_S)]
    at, ramp = FREE_S, 1.8
    while at + 2.0 * ramp + 10.0 <= seconds - 1.0:
        hold_s = min(float(rng.uniform(10.0, 20.0)), seconds - 1.0 - at - 2.0 * ramp)
        end = at + hold_s + 2.0 * ramp
        inside = _between(signals.time_s, at, end, ramp)
        # The level sinks slightly during a hold: some air and muscle tone are lost.
        leak = 1.0 - 0.03 * np.clip((signals.time_s - at) / hold_s, 0.0, 1.0)
        deep = build.amplitude_mm * float(rng.uniform(1.9, 2.2)) * leak
        deep_thorax = build.amplitude_mm * build.thorax_share * float(rng.uniform(3.0, 3.8)) * leak
        abdomen_mm = abdomen_mm * (1.0 - inside) + deep * inside
        thorax_mm = thorax_mm * (1.0 - inside) + deep_thorax * inside
        events.append(Event(name="hold", start_s=at + ramp, end_s=end - ramp))
        at = end + float(rng.uniform(7.0, 10.0))
    return Timeline(signals=replace(signals, abdomen_mm=abdomen_mm, thorax_mm=thorax_mm), events=tuple(events))


def _drift(signals: Signals, seconds: float, rng: np.random.Generator) -> Timeline:
    """Baseline drift to the end of the recording, as when muscles relax."""
    start = min(FREE_S, 0.3 * seconds)
    total_mm = float(rng.uniform(3.0, 5.0)) * (1.0 if rng.random() < 0.5 else -1.0)
    share = _smooth(0.5 * (signals.time_s - start) / (seconds - start)) / 0.5
    return Timeline(
        signals=replace(
            signals,
            abdomen_mm=signals.abdomen_mm + total_mm * share,
            thorax_mm=signals.thorax_mm + 0.5 * total_mm * share,
        ),
        events=(
            Event(name="free", start_s=0.0, end_s=start),
            Event(name="drift", start_s=start, end_s=seconds, detail={"abdomen_mm": total_mm}),
        ),
    )


def _events(build: Build, seconds: float, rng: np.random.Generator) -> Timeline:
    """Breathing episodes of every kind in sequence, as many as the recording's length allows."""
    course = lay_out_course(build, time_grid(seconds), seconds, rng, quiet_s=FREE_S, first_s=USUAL_S)
    events = [
        Event(name=episode.kind, start_s=episode.start_s, end_s=episode.end_s, detail=episode.detail)
        for episode in course.episodes
    ]
    free = Event(name="free", start_s=0.0, end_s=events[0].start_s if events else seconds)
    return Timeline(signals=course.signals, events=(free, *events))


def _shift(signals: Signals, seconds: float, rng: np.random.Generator) -> Timeline:
    """Shift the patient on the couch within one second."""
    start = max(22.0, 0.55 * seconds)
    length, angle = float(rng.uniform(7.0, 13.0)), float(rng.uniform(0.0, 2.0 * np.pi))
    turn = float(rng.uniform(1.0, 2.0)) * (1.0 if rng.random() < 0.5 else -1.0)
    detail = {"x_mm": length * np.cos(angle), "y_mm": length * np.sin(angle), "turn_deg": turn}
    return Timeline(
        signals=signals,
        events=(
            Event(name="free", start_s=0.0, end_s=start),
            Event(name="shift", start_s=start, end_s=start + 1.0, detail=detail),
        ),
    )


def _occlusion(signals: Signals, seconds: float, rng: np.random.Generator) -> Timeline:
    """Pass a hand over the ROI; later hide one sticker under a cloth for 4 s."""
    hand = max(FREE_S, 0.45 * seconds)
    cloth = hand + 8.0
    marker = int(rng.integers(0, 4))
    return Timeline(
        signals=signals,
        events=(
            Event(name="free", start_s=0.0, end_s=hand),
            Event(name="hand", start_s=hand, end_s=hand + 4.0),
            Event(name="marker_hidden", start_s=cloth, end_s=cloth + 4.0, detail={"marker": marker}),
        ),
    )
