"""Measures a falsified recording, and compares every frame that is reported as measured with the patient's truth.

The frames are rendered, not read from a file. The model is learned on honest frames of the same volunteer; the
reference is an end of exhale.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.core.breath import GateSignal, SignalChoice
from engine.core.clock import NS_PER_US, ManualClock
from engine.core.commands import Arm
from engine.core.errors import ModelError
from engine.core.frames import BodyPosition, BoolArray, FloatArray, Measurement, MeasurementState, RgbdFrame
from engine.core.gate_state import GateState, HoldReason
from engine.core.motion_model import MotionModel
from engine.core.signals import HeadDirection, depends_on_head
from engine.gating.frame_checks import unseen_signal
from engine.gating.gate import Gate, GateEvent, Interruption, step_gate
from engine.gating.limits import GateLimits
from engine.gating.supervision.patient_shift import Movement
from engine.gating.supervision.supervisor import FrameSupervisor
from engine.gating.windows import amplitude_window
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from lab.evaluation.integrity.cases import HONEST_S, POSITION, Case
from lab.phantom.builds import NO_DEPARTURE, Departure
from lab.phantom.falsifications import Falsification, Move, Stale
from lab.phantom.scene import Script
from lab.phantom.sensor import USUAL
from lab.phantom.studio import BREATHING_MODES, Studio
from lab.phantom.truth import CELL_PX, POINTS_RC

FPS = 30.0
REGULAR = "regular"
TRAINING_S = 45.0
SCRIPT_S = 130.0
SEARCH_S = (46.0, 54.0)
"""Time within which an end of exhale is chosen as the reference [s]."""
CELL = (32, 9)
"""Row and column of a gated cell of 10 px; in the blind areas of the catalogue."""
POINT = 3
WIDE = amplitude_window(lower_mm=-50.0, upper_mm=50.0)
"""In place of the windows, which follow from the whole recording."""
WINDOW_SHARE = 0.35
"""Upper end of the exhale window, as a share of the true range of its signal."""
BELOW_MM = 1.5
WRONG_MM = 1.0
MOVED_DEG = 0.5
SHIFTED_MM = 3.0
"""A reported shift of the markers: breathing moves them by less."""

SIGNALS = (
    SignalChoice(signal=GateSignal.WHOLE),
    SignalChoice(signal=GateSignal.THORAX),
    SignalChoice(signal=GateSignal.ABDOMEN),
    SignalChoice(signal=GateSignal.REGION, row=CELL[0], column=CELL[1]),
    SignalChoice(signal=GateSignal.POINT, row=int(POINTS_RC[POINT][0]), column=int(POINTS_RC[POINT][1]), index=POINT),
)
SETTINGS = PipelineSettings(cell_px=CELL_PX, points=tuple((int(row), int(column)) for row, column in POINTS_RC))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session:
    """What was measured after a falsification began, frame by frame.

    Attributes
    ----------
    seconds
        Time since it began [s], shape (n,).
    is_measured
        Whether the frame was reported as measured, shape (n,).
    is_held
        Whether the supervision of the frames held the beam, or the coverage of a signal does, shape (n,).
    error_mm
        Measured less true motion of each signal [mm], shape (n, signals); NaN where not measured, and of a signal that
        may not gate because the head direction is unknown or the camera sees too little of it.
    is_on
        Whether a gate on each signal had the beam on, shape (n, signals).
    outside_mm
        How far the true motion is outside of the signal's window [mm], shape (n, signals).
    is_moved
        Whether a rigid movement of the patient was reported: above 1 mm in height, 3 mm along the couch or half a
        degree, shape (n,).
    reasons
        First text of each kind of loss and hold.
    first_s
        Time of the first frame with each code of a loss or hold, and of a reported movement (`POSITION`) [s].
    """

    case: Case
    seconds: FloatArray
    is_measured: BoolArray
    is_held: BoolArray
    error_mm: FloatArray
    is_on: BoolArray
    outside_mm: FloatArray
    reasons: tuple[str, ...]
    is_moved: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    first_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Volunteer:
    """A volunteer whose model was learned, and the time of an end of exhale.

    Without a model ``refusal`` says why it could not be learned.
    """

    number: int
    seed: int
    model: MotionModel | None
    reference_s: float
    is_turned: bool = False
    head_direction: HeadDirection | None = HeadDirection.TOP
    sensor: str = USUAL
    departure: Departure = NO_DEPARTURE
    refusal: str = ""


def learn(
    number: int,
    seed: int,
    *,
    is_turned: bool,
    sensor: str = USUAL,
    head_direction: HeadDirection | None = HeadDirection.TOP,
    departure: Departure = NO_DEPARTURE,
    must_learn: bool = True,
    on_frame: Callable[[], None] = lambda: None,
) -> Volunteer:
    """Learn a volunteer's model on honest frames.

    Raises
    ------
    ModelError
        The frames were not enough, and the model is not one that may be missing.
    """
    studio = Studio(_script(number, seed, _turned(None, is_turned=is_turned), sensor=sensor, departure=departure))
    lost: Counter[str] = Counter()
    pipeline = Pipeline(studio.scene.rig.calibration, _settings(head_direction), ManualClock(), InlineTrainer())
    for index in range(int(TRAINING_S * FPS)):
        measured = pipeline.measure(_frame(studio, index, index / FPS))
        lost.update([] if measured.lost is None else [measured.lost.reason.value])
        on_frame()
        if pipeline.learner.status.model is not None:
            break
    model = pipeline.learner.status.model
    refusal = f"volunteer {number}: {TRAINING_S:g} s were not enough to learn a model"
    if model is None and must_learn:
        raise ModelError(refusal)
    return Volunteer(
        number=number,
        seed=seed,
        model=model,
        reference_s=_end_of_exhale(studio),
        is_turned=is_turned,
        head_direction=head_direction,
        sensor=sensor,
        departure=departure,
        refusal=next((code for code, _ in lost.most_common(1)), "training") if model is None else "",
    )


def run(volunteer: Volunteer, case: Case, on_frame: Callable[[], None] = lambda: None) -> Session:
    """Measure one case; nothing is measured where no model could be learned."""
    if volunteer.model is None:
        return _unlearned(volunteer, case)
    start_s = volunteer.reference_s
    falsification = replace(case.falsification, start_s=start_s + HONEST_S)
    turned = _turned(falsification, is_turned=volunteer.is_turned)
    script = _script(
        volunteer.number,
        volunteer.seed,
        turned,
        sensor=volunteer.sensor,
        scenario=case.scenario,
        departure=volunteer.departure,
        seconds=max(SCRIPT_S, start_s + HONEST_S + case.seconds),
    )
    studio = Studio(script)
    if case.scenario != REGULAR:
        start_s = _end_of_exhale(studio)
    recorder = _Recorder(studio.scene.rig.calibration, volunteer.model, volunteer.head_direction)
    frames = _frames(studio, start_s, HONEST_S + case.seconds, case.falsification.stale, volunteer.seed)
    for frame, time_s in frames:
        recorder.take(frame, _truth_mm(studio, time_s))
        on_frame()
    return recorder.session(case)


def _settings(head_direction: HeadDirection | None) -> PipelineSettings:
    return replace(SETTINGS, superior_px=None if head_direction is None else head_direction.superior_px)


def _script(
    number: int,
    seed: int,
    falsification: Falsification | None,
    *,
    sensor: str,
    scenario: str = REGULAR,
    departure: Departure = NO_DEPARTURE,
    seconds: float = SCRIPT_S,
) -> Script:
    return Script(
        scenario=scenario,
        volunteer=number,
        seconds=seconds,
        fps=FPS,
        seed=seed,
        falsification=falsification,
        departure=departure,
        sensor=sensor,
    )


def _unlearned(volunteer: Volunteer, case: Case) -> Session:
    frames = int(case.seconds * FPS)
    none = np.zeros(frames, dtype=np.bool_)
    return Session(
        case=case,
        seconds=np.arange(frames) / FPS,
        is_measured=none,
        is_held=none,
        error_mm=np.full((frames, len(SIGNALS)), np.nan),
        is_on=np.zeros((frames, len(SIGNALS)), dtype=np.bool_),
        outside_mm=np.zeros((frames, len(SIGNALS))),
        reasons=(f"{volunteer.refusal}: no model was learned",),
        is_moved=none,
    )


def _turned(falsification: Falsification | None, *, is_turned: bool) -> Falsification | None:
    """Turn the patient feet first, from long before the recording; nothing else is false then."""
    if not is_turned:
        return falsification
    return Falsification(start_s=-10.0, body=Move(turn_deg=180.0, over_s=1.0))


def _end_of_exhale(studio: Studio) -> float:
    times_s = np.arange(*SEARCH_S, 1.0 / FPS)
    weights = studio.scene.breathing.weights(times_s)
    return float(times_s[int(np.argmin(weights[:, :BREATHING_MODES].sum(axis=1)))])


def _frame(studio: Studio, index: int, time_s: float) -> RgbdFrame:
    timestamp_us = round(time_s * 1e6)
    return RgbdFrame(
        index=index,
        device_index=index,
        missed_frames=0,
        timestamp_us=timestamp_us,
        color_timestamp_us=timestamp_us,
        received_ns=timestamp_us * NS_PER_US,
        depth_mm=studio.depth_frame(index, time_s),
        color=studio.color_frame(index, time_s),
    )


def _frames(
    studio: Studio, start_s: float, seconds: float, stale: Stale | None, seed: int
) -> Iterator[tuple[RgbdFrame, float]]:
    """Yield the frames and their true times [s]; stale pictures come with the times of new ones."""
    rng = np.random.default_rng((seed, 77))
    kept: list[RgbdFrame] = []
    onset = round(HONEST_S * FPS)
    for number in range(int(seconds * FPS)):
        time_s = start_s + number / FPS
        index = round(time_s * FPS)
        if stale is None:
            yield _frame(studio, index, time_s), time_s
            continue
        if number < onset or stale.is_of_moving:
            kept.append(_frame(studio, index, time_s))
        if number < onset:
            yield kept[-1], time_s
        elif stale.torn_frames:
            yield _torn(kept[-1], kept[-1 - stale.torn_frames]), time_s
        elif stale.averaged_frames:
            yield _averaged(kept[-stale.averaged_frames :]), time_s
        else:
            old = kept[_old_index(stale, number - onset, len(kept))]
            yield _with_times(old, index, time_s, stale.flicker, rng), time_s


def _old_index(stale: Stale, number: int, kept: int) -> int:
    """Return which of the kept frames is shown as the ``number``-th stale one."""
    if stale.delay_s_per_s:
        return kept - 1 - round(stale.delay_s_per_s * number)
    return kept - stale.ring + number % stale.ring


def _torn(frame: RgbdFrame, old: RgbdFrame) -> RgbdFrame:
    """Return the frame with the lower half of both pictures from ``old``."""
    depth_mm, color = frame.depth_mm.copy(), frame.color.copy()
    depth_mm[len(depth_mm) // 2 :] = old.depth_mm[len(depth_mm) // 2 :]
    color[len(color) // 2 :] = old.color[len(color) // 2 :]
    return replace(frame, depth_mm=depth_mm, color=color)


def _averaged(frames: list[RgbdFrame]) -> RgbdFrame:
    """Return the last frame with the mean of the depths that have a reading in each of the frames."""
    depths = np.stack([frame.depth_mm for frame in frames])
    depth_mm = np.where((depths > 0).all(axis=0), np.rint(depths.mean(axis=0)), 0).astype(np.uint16)
    return replace(frames[-1], depth_mm=depth_mm)


def _with_times(frame: RgbdFrame, index: int, time_s: float, flicker: float, rng: np.random.Generator) -> RgbdFrame:
    depth_mm = frame.depth_mm
    if flicker:
        depth_mm = depth_mm.copy()
        chosen = (rng.random(depth_mm.shape) < flicker) & (depth_mm > 0)
        depth_mm[chosen] += rng.integers(0, 2, int(chosen.sum()), dtype=np.uint16) * np.uint16(2)
        depth_mm[chosen] -= np.uint16(1)
    timestamp_us = round(time_s * 1e6)
    return replace(
        frame,
        index=index,
        device_index=index,
        timestamp_us=timestamp_us,
        color_timestamp_us=timestamp_us,
        received_ns=timestamp_us * NS_PER_US,
        depth_mm=depth_mm,
    )


def _truth_mm(studio: Studio, time_s: float) -> FloatArray:
    """Return the true depth of each signal [mm]."""
    scene = studio.scene
    weights = scene.breathing.weights(time_s)
    cells, halves, points = scene.roi_truth(time_s).cells(weights, scene.raised_share(time_s))
    return np.array([halves.mean(), halves[0], halves[1], cells[CELL], points[POINT]])


class _Recorder:
    """Measures frames, and lets a gate on each signal decide."""

    def __init__(self, calibration: Calibration, model: MotionModel, head_direction: HeadDirection | None) -> None:
        self._head_direction = head_direction
        self._pipeline = Pipeline(calibration, _settings(head_direction), ManualClock(), InlineTrainer())
        self._pipeline.learner.models.resume(model)
        self._measurements: list[Measurement] = []
        self._holds: list[tuple[Interruption, ...]] = []
        self._truth_mm: list[FloatArray] = []
        self._moved: list[bool] = []
        self._supervisor = FrameSupervisor(_limits(0.0, 1.0))

    def take(self, frame: RgbdFrame, truth_mm: FloatArray) -> None:
        """Measure a frame; ``truth_mm`` is the true depth of each signal."""
        measurement = self._pipeline.measure(frame)
        self._measurements.append(measurement)
        self._truth_mm.append(truth_mm)
        gated = measurement.as_gated
        self._holds.append(
            self._supervisor.check(
                frame,
                gated,
                window=WIDE,
                model=self._pipeline.learner.status.model,
                has_reference=gated.motion is not None or bool(self._holds),
                notices=self._pipeline.learner.take_notices(),
            )
        )
        self._moved.append(_is_moved(measurement.position, self._supervisor.movement))

    def session(self, case: Case) -> Session:
        """Return what was measured since the falsification began."""
        onset = round(HONEST_S * FPS)
        truth_mm = np.array(self._truth_mm)
        true_mm = truth_mm[0] - truth_mm
        measured_mm = np.array([_signals_mm(measurement) for measurement in self._measurements])
        # The reference is the mean of some frames: what it differs by is no falsification.
        measured_mm -= np.nanmedian(measured_mm[:onset] - true_mm[:onset], axis=0)
        swing_mm = true_mm[:onset].max(axis=0)
        windows = [(-BELOW_MM, WINDOW_SHARE * float(swing)) for swing in swing_mm]
        outside_mm = np.stack(
            [np.maximum(low - true_mm[:, i], true_mm[:, i] - high) for i, (low, high) in enumerate(windows)], axis=1
        )
        may_gate = [self._head_direction is not None or not depends_on_head(choice) for choice in SIGNALS]
        measured_mm[:, np.logical_not(may_gate)] = np.nan
        is_unseen = np.array([[bool(text) for text in _unseen(one)] for one in self._measurements])
        measured_mm[is_unseen] = np.nan
        is_on = np.stack([self._beam(i, *window) for i, window in enumerate(windows)], axis=1)
        return Session(
            case=case,
            seconds=(np.arange(len(true_mm)) - onset)[onset:] / FPS,
            is_measured=np.array([one.as_gated.state is MeasurementState.MEASURING for one in self._measurements])[
                onset:
            ],
            is_held=(np.array([bool(one) for one in self._holds]) | is_unseen.any(axis=1))[onset:],
            error_mm=(measured_mm - true_mm)[onset:],
            is_on=is_on[onset:],
            outside_mm=np.maximum(outside_mm, 0.0)[onset:],
            reasons=self._reasons(onset),
            is_moved=np.array(self._moved)[onset:],
            first_s=self._first_s(onset),
        )

    def _beam(self, signal: int, lower_mm: float, upper_mm: float) -> BoolArray:
        """Whether a gate on a signal has the beam on, shape (n,)."""
        limits = replace(_limits(lower_mm, upper_mm, SIGNALS[signal]), head_direction=self._head_direction)
        gate, is_armed, found = Gate(), False, []
        for measurement, holds in zip(self._measurements, self._holds, strict=True):
            if not is_armed and measurement.as_gated.motion is not None:
                gate, is_armed = step_gate(gate, Arm(operator="evaluation"), measurement.received_ns, limits), True
            events: tuple[GateEvent, ...] = (*holds, measurement.as_gated, *holds)
            for event in events:
                gate = step_gate(gate, event, measurement.received_ns, limits)
            found.append(gate.state is GateState.BEAM_ON)
        return np.array(found)

    def _first_s(self, onset: int) -> dict[str, float]:
        found: dict[str, float] = {}
        for number, (measurement, holds) in enumerate(
            zip(self._measurements[onset:], self._holds[onset:], strict=True)
        ):
            codes: list[str] = [hold.reason.value for hold in holds]
            if measurement.reason is not None:
                codes.append(measurement.reason.reason.value)
            if any(_unseen(measurement)):
                codes.append(HoldReason.COVERAGE_LOW.value)
            if self._moved[onset + number]:
                codes.append(POSITION)
            for code in codes:
                found.setdefault(code, number / FPS)
        return found

    def _reasons(self, onset: int) -> tuple[str, ...]:
        found: dict[str, str] = {}
        for measurement, holds in zip(self._measurements[onset:], self._holds[onset:], strict=True):
            reason = measurement.reason
            if reason is not None:
                found.setdefault(reason.reason, f"{reason.reason}: {reason.detail}")
            for hold in holds:
                found.setdefault(hold.reason, f"{hold.reason}: {hold.detail}")
            for text in filter(None, _unseen(measurement)):
                found.setdefault(HoldReason.COVERAGE_LOW, f"{HoldReason.COVERAGE_LOW}: {text}")
        return tuple(found.values())


def _is_moved(position: BodyPosition | None, movement: Movement | None) -> bool:
    """Whether a movement of the patient is reported, by the surface or by the markers."""
    if movement is not None and (movement.shift_mm > SHIFTED_MM or abs(movement.on_couch_deg) > MOVED_DEG):
        return True
    if position is None:
        return False
    turn_deg = max(abs(position.tilt_deg), abs(position.roll_deg))
    return abs(position.height_mm) > WRONG_MM or turn_deg > MOVED_DEG


def _limits(lower_mm: float, upper_mm: float, choice: SignalChoice = SIGNALS[0]) -> GateLimits:
    window = replace(amplitude_window(lower_mm=lower_mm, upper_mm=upper_mm), choice=choice)
    return GateLimits(window=window, is_played=True)


def _unseen(measurement: Measurement) -> list[str | None]:
    """Return for each signal why a gate on it would be held for its coverage; None where it would not."""
    motion = measurement.motion
    return [None if motion is None else unseen_signal(motion.seen, _limits(0.0, 1.0, choice)) for choice in SIGNALS]


def _signals_mm(measurement: Measurement) -> list[float]:
    motion = measurement.motion
    return [np.nan if motion is None else choice.value_in(motion) for choice in SIGNALS]
