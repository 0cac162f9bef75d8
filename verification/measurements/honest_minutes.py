"""How often the gate's rules hold people who breathe as they did at the reference, from recordings of people.

Run: ``python -m verification.measurements.honest_minutes FILE [FILE ...]``, with recordings of breathing (CSV of
markers, RPM export, two columns of seconds and mm). Each is played to the monitor, the supervision and the gate, as the
signal *whole* at 30 frames a second, each minute as a session of its own: `LEARNED_S` before it are learned from, and
the reference is the low level of the last ten seconds of these. The window is that of a beam at the end of exhale.

**An honest minute** is decided from the recording alone, by no rule of the gate: in each of its spans of ten seconds
the low level (5th percentile) lies within `LEVEL_MM` and `LEVEL_SHARE` of a breath of the reference, the depth (5th to
95th percentile) within a factor of two, and the median within `MEDIAN_SHARE` of a breath: a person who talks or coughs
stays elsewhere for longer. Held is every frame for which the gate's reason is neither the window nor the dwell. Exits
with 1 where more than `MOST_PERCENT` of the frames in honest minutes are held.
"""

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from engine.core.frames import FloatArray, RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningStatus
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.tracking.breath_tracker import BreathTracker
from engine.offline.offline_gate import OfflineGate
from engine.qa.recorded_traces import read_trace
from tests.support.gating.streams import measured, motion_of
from tests.support.service.fake_engine import make_model

FPS, US_PER_S = 30.0, 1e6
LEARNED_S, SPAN_S, MINUTE_S = 30.0, 10.0, 60.0
LEVEL_MM, LEVEL_SHARE, MEDIAN_SHARE, DEEPEST = 1.0, 0.2, 0.5, 2.0
WINDOW_SHARE, BELOW_MM = 0.35, 2.0
MOST_PERCENT = 1.0
WITHIN_RULES = {None, HoldReason.OUTSIDE_WINDOW, HoldReason.DWELL}


@dataclass(kw_only=True)
class Played:
    """What the gate did in a recording: frames, and those held by reason, in honest minutes and in the others."""

    name: str
    minutes: int = 0
    honest_minutes: int = 0
    honest_frames: int = 0
    honest_held: Counter[str] = field(default_factory=Counter)
    other_frames: int = 0
    other_held: Counter[str] = field(default_factory=Counter)


class Span(NamedTuple):
    """The low level, the depth and the median of ten seconds [mm]."""

    level_mm: float
    depth_mm: float
    median_mm: float


def figures(signal_mm: FloatArray) -> Span:
    """Return the figures of a span."""
    low, median, high = np.percentile(signal_mm, [5.0, 50.0, 95.0])
    return Span(float(low), float(high - low), float(median))


def is_honest(signal_mm: FloatArray, reference: Span) -> bool:
    """Whether each span of ten seconds lies and breathes as at the reference."""
    near_mm = min(LEVEL_MM, LEVEL_SHARE * reference.depth_mm)
    return all(
        abs(span.level_mm - reference.level_mm) <= near_mm
        and abs(span.median_mm - reference.median_mm) <= MEDIAN_SHARE * reference.depth_mm
        and reference.depth_mm / DEEPEST <= span.depth_mm <= reference.depth_mm * DEEPEST
        for span in map(figures, np.split(signal_mm, round(MINUTE_S / SPAN_S)))
    )


def frame_at(index: int, timestamp_us: int) -> RgbdFrame:
    """Return the time of a frame; its pictures are not looked at."""
    return RgbdFrame(
        index=index,
        device_index=index,
        timestamp_us=timestamp_us,
        color_timestamp_us=timestamp_us,
        received_ns=timestamp_us * 1000,
        depth_mm=np.zeros((1, 1), np.uint16),
        color=np.zeros((1, 1, 3), np.uint8),
    )


def reasons(signal_mm: FloatArray) -> Iterator[HoldReason | None]:
    """Yield the gate's reason after each frame; None before the reference is set."""
    learned = round(LEARNED_S * FPS)
    reference = figures(signal_mm[learned - round(SPAN_S * FPS) : learned])
    level_mm = reference.level_mm
    window = amplitude_window(lower_mm=-BELOW_MM, upper_mm=WINDOW_SHARE * reference.depth_mm)
    gate = OfflineGate(GateLimits(window=window, max_duty_percent=100.0, is_played=True))
    tracker = BreathTracker(window.choices)
    status = LearningStatus(model=make_model(), has_reference=True)
    for index, value_mm in enumerate(signal_mm):
        timestamp_us = round(index / FPS * US_PER_S)
        if index == learned:
            tracker.move(motion_of(value_mm), motion_of(value_mm - level_mm), is_end_exhale=True)
        motion = motion_of(value_mm if index < learned else value_mm - level_mm)
        breaths = tracker.follow(motion, timestamp_us)
        if index < learned:
            yield None
            continue
        measurement = replace(measured(index, motion), timestamp_us=timestamp_us, breaths=breaths)
        yield gate.decide(frame_at(index, timestamp_us), measurement, status, ()).reason


def signal_of_recording(path: Path) -> FloatArray:
    """Return a recording's signal at the gate's rate [mm], inhale positive; two columns are seconds and mm."""
    columns = path.read_text(encoding="utf-8-sig").splitlines()[0].split()
    if len(columns) == len(("seconds", "mm")):
        time_s, value_mm = np.loadtxt(path).T
    else:
        trace = read_trace(path)
        time_s, value_mm = trace.time_s, trace.motion_mm
    return np.interp(np.arange(time_s[0], time_s[-1], 1.0 / FPS), time_s, value_mm)


def played(path: Path) -> Played:
    """Play a recording to the gate."""
    signal_mm = signal_of_recording(path)
    first, length = round(LEARNED_S * FPS), round(MINUTE_S * FPS)
    result = Played(name=path.name)
    for begin in range(first, len(signal_mm) - length + 1, length):
        session_mm = signal_mm[begin - first : begin + length]
        reference = figures(session_mm[first - round(SPAN_S * FPS) : first])
        found = list(reasons(session_mm))[first:]
        held = Counter(str(one) for one in found if one not in WITHIN_RULES)
        result.minutes += 1
        if is_honest(session_mm[first:], reference):
            result.honest_minutes += 1
            result.honest_frames += length
            result.honest_held += held
        else:
            result.other_frames += length
            result.other_held += held
    return result


def main(paths: list[Path]) -> int:
    """Print a line for each recording and for all; return the exit code."""
    every = [played(path) for path in paths]
    for one in every:
        others = _percent(one.other_held, one.other_frames)
        held_text = f"held {_percent(one.honest_held, one.honest_frames)}; in the others {others}"
        _tell(f"{one.name}: {one.honest_minutes} of {one.minutes} minutes honest, {held_text}")
    frames = sum(one.honest_frames for one in every)
    held = sum((one.honest_held for one in every), Counter[str]())
    minutes, all_minutes = sum(one.honest_minutes for one in every), sum(one.minutes for one in every)
    _tell(f"{len(every)} recordings, {minutes} honest minutes of {all_minutes}: held {_percent(held, frames)}")
    return int(frames == 0 or 100.0 * held.total() > MOST_PERCENT * frames)


def _percent(held: "Counter[str]", frames: int) -> str:
    if frames == 0:
        return "-"
    parts = ", ".join(f"{reason} {100.0 * count / frames:.1f} %" for reason, count in held.most_common(3))
    return f"{100.0 * held.total() / frames:.1f} %" + (f" ({parts})" if parts else "")


def _tell(text: str) -> None:
    print(text)  # noqa: T201 - it is what the command is for


if __name__ == "__main__":
    sys.exit(main([Path(name) for name in sys.argv[1:]]))
