"""Runs a breathing monitor on each configured signal, on measured frames only.

Owned by the pipeline's thread. Lost frames are left out, and of each signal those that show less than half of it, since
the model extrapolates there; after more than half a second without a measured frame the phase has to be found again.
Changes of the measurement must not count as breathing: if an operator sets a new reference, the monitors' levels shift
with it, and drift is measured from the patient's position then; if a new model takes over with a transferred reference,
the signals continue; in all other cases the monitors restart.

Measures frames from before the model, once there is one, as live frames are; runs in the trainer's thread.
"""

import math
from functools import lru_cache
from operator import attrgetter

from engine.core.breath import Breath, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import FloatArray, Motion, PhaseLag, Projection, SeenShares
from engine.motion.breathing import (
    BreathingState,
    correct_baseline,
    follow_breathing,
    shifted,
    start_breathing,
    with_baseline,
)
from engine.motion.learning.prepared_model import PreparedModel, Reference, SeenWeights
from engine.motion.learning.reference_proposals import PastMotion
from engine.motion.learning.reference_transfer import Explain
from engine.motion.learning.training_set import TrainingFrame, Vertices

US_PER_S = 1e6
MAX_SIGNALS = 4
MIN_SEEN_SHARE = 0.5
_BREATH = attrgetter("breath")


def check_signals(signals: tuple[SignalChoice, ...]) -> None:
    """Raise InvalidValueError for more than `MAX_SIGNALS` signals or a repeated one."""
    if len(signals) > MAX_SIGNALS:
        raise InvalidValueError("breath_signals", len(signals), f"at most {MAX_SIGNALS} signals")
    if len(set(signals)) < len(signals):
        raise InvalidValueError("breath_signals", [signal.label for signal in signals], "each signal once")


class BreathTracker:
    """One breathing monitor per signal."""

    def __init__(self, signals: tuple[SignalChoice, ...]) -> None:
        self._states = tuple(start_breathing(signal) for signal in signals)
        self._active: PreparedModel | None = None

    def has_reference_changed(self, active: PreparedModel, *, is_reference_new: bool) -> bool:
        """Update the model in use; return whether the reference changed while the model did not.

        The caller then calls `move` before the frame is added.
        """
        is_same_model = active is self._active
        self._active = active
        if is_reference_new and not is_same_model:
            self._states = tuple(start_breathing(state.choice) for state in self._states)
        return is_reference_new and is_same_model

    def move(self, before: Motion, now: Motion, *, is_end_exhale: bool) -> None:
        """Shift the monitors by the change of one frame's motion from the old to the new reference.

        Drift then counts from the last end of exhale; of the first signal from the reference itself where that is the
        mean of its last ends of exhale: the last one alone may have been a hitch.
        """
        moved = [shifted(state, state.choice.value_in(now) - state.choice.value_in(before)) for state in self._states]
        self._states = tuple(
            with_baseline(state, 0.0) if is_end_exhale and state is moved[0] else _with_current_baseline(state)
            for state in moved
        )

    def correct(self, choice: SignalChoice, by: float) -> None:
        """Apply an operator's confirmed change of a signal's baseline [mm; l for the volume]."""
        self._states = tuple(correct_baseline(state, by) if state.choice == choice else state for state in self._states)

    def follow(self, motion: Motion, timestamp_us: int) -> tuple[Breath, ...]:
        """Add a measured frame; return the breathing figures of each signal."""
        seconds = timestamp_us / US_PER_S
        states = []
        for state in self._states:
            states.append(follow_breathing(state, seconds, _seen_mm(state.choice, motion)))  # noqa: PERF401 - sooner
        self._states = tuple(states)
        return tuple(map(_BREATH, states))


def _seen_mm(choice: SignalChoice, motion: Motion) -> float:
    """Return a signal [mm; l for the volume]; NaN where the frame shows too little of it."""
    return choice.value_in(motion) if choice.seen_in(motion.seen) >= MIN_SEEN_SHARE else math.nan


def _with_current_baseline(state: BreathingState) -> BreathingState:
    """Measure drift from the present end of exhale; restart the monitor if that is unknown."""
    level = state.breath.baseline
    return start_breathing(state.choice) if level is None else with_baseline(state, level)


def motion_from(
    reference: Reference,
    active: PreparedModel,
    outcome: Projection,
    surface: FloatArray,
    depth_mm: FloatArray,
    lags: tuple[PhaseLag, ...] = (),
) -> Motion:
    """Return the motion of a projected frame from a reference.

    Parameters
    ----------
    surface
        Its vertices [mm], shape (nodes, 3).
    depth_mm
        Its mean depth of every region [mm], by the regions of ``active``.
    """
    motion_mm = reference.regions_mm - depth_mm
    regions = active.regions
    (cells, points_from, named_from), shape = regions.ends, (regions.rows, regions.columns)
    surface.setflags(write=False)
    whole, thorax, abdomen = motion_mm[cells:points_from].tolist()
    weights = active.seen_weights
    return Motion(
        whole_mm=whole,
        thorax_mm=thorax,
        abdomen_mm=abdomen,
        volume_l=reference.volume_above_l(surface),
        regions_mm=motion_mm[:cells].reshape(shape),
        regions_depth_mm=depth_mm[:cells].reshape(shape),
        points_mm=motion_mm[points_from:named_from],
        named_mm=motion_mm[named_from:],
        projection=outcome,
        lags=lags,
        surface_mm=surface,
        split_rows=regions.layout.split,
        seen=weights.by_region(weights.shares(outcome.is_seen)),
        reference_seen=_reference_seen(reference, weights),
    )


@lru_cache(maxsize=4)
def _reference_seen(reference: Reference, weights: SeenWeights) -> SeenShares:
    """Return what was seen at a reference; it stands for many frames. Both are compared by identity."""
    return weights.by_region(reference.seen_shares)


class PastMeasurement:
    """Measures frames in order of time, with the breath of the first signal; motion is from the first frame."""

    def __init__(
        self, active: PreparedModel, signals: tuple[SignalChoice, ...], explain: Explain, vertices: Vertices
    ) -> None:
        self._active, self._explain, self._vertices = active, explain, vertices
        self._breaths = BreathTracker(signals[:1])
        self._coefficients: FloatArray | None = None
        self._reference: Reference | None = None

    def __call__(self, frame: TrainingFrame) -> PastMotion | None:
        """Return what is followed of a frame; None where the model does not explain it, and without a signal."""
        active = self._active
        outcome = self._explain(active, frame.roi, self._coefficients)
        self._coefficients = None if outcome is None else outcome.coefficients
        if outcome is None:
            return None
        surface = self._vertices(frame.nodes_px, active.node_depth_mm(outcome.coefficients))
        if self._reference is None:
            shares = active.seen_weights.shares(outcome.is_seen)
            self._reference = active.reference(outcome.coefficients, surface, shares)
        depth_mm = active.regions.depth_mm(outcome.coefficients)
        motion = motion_from(self._reference, active, outcome, surface, depth_mm)
        breaths = self._breaths.follow(motion, frame.timestamp_us)
        return PastMotion(outcome.coefficients, motion, breaths[0], self._reference) if breaths else None
