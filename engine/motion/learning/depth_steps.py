"""Comparison of the sensor's depth steps of a stored model with the session's.

Each session finds the steps in its first pictures (`engine.motion.tracking.region_tracker`). A model that was learned
with another reading of the depths is wrong by tenths of a millimetre, in a pattern that repeats with every breath.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from engine.calibration.quantisation import DepthSteps, depth_table_mm
from engine.core.errors import ModelMismatchError
from engine.core.frames import FloatArray
from engine.core.motion_model import MotionModel
from engine.motion.learning.tasks import Candidate, Outcome

MAX_DIFFERENCE_MM = 0.3
"""Largest root mean square difference of the depths. Three sessions each of three virtual volunteers differ by up to
0.16 mm, because the steps are estimated again; with steps and without differ by 0.53 mm and more."""
MARGIN_MM = 20.0
ADVICE = "the model was learned with another reading of the sensor's depths: a new one is learned"


def stored_steps(steps: DepthSteps | None) -> tuple[float, ...]:
    """Return the steps as a model stores them; empty for a sensor without steps."""
    return () if steps is None else (steps.offset_per_mm, steps.step_per_mm, steps.rounding_mm)


def steps_mismatch(model: MotionModel, session: tuple[float, ...] | None) -> ModelMismatchError | None:
    """Return why a model does not fit the session's steps; None where it does, or where either is not known."""
    if model.depth_steps is None or session is None or model.depth_steps == session:
        return None
    low, high = np.percentile(model.mean_mm, [5.0, 95.0])
    span = slice(int(low - MARGIN_MM), int(high + MARGIN_MM) + 1)
    difference_mm = _table_mm(model.depth_steps)[span] - _table_mm(session)[span]
    rms_mm = float(np.sqrt(np.mean(np.square(difference_mm, dtype=np.float64))))
    if rms_mm <= MAX_DIFFERENCE_MM:
        return None
    bound = f"at most {MAX_DIFFERENCE_MM:g} mm from the session's"
    return ModelMismatchError("model.depth_steps", f"{rms_mm:.2f} mm", bound, ADVICE)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepsJob:
    """The job of a fit, whose model gets the steps of the sensor's readings."""

    job: Callable[[], Outcome]
    steps: tuple[float, ...] | None

    def __call__(self) -> Outcome:
        """Return the new model."""
        outcome = self.job()
        assert isinstance(outcome, Candidate), "a fit gives a candidate"
        model = replace(outcome.active.model, depth_steps=self.steps)
        return replace(outcome, active=replace(outcome.active, model=model))


def _table_mm(stored: tuple[float, ...]) -> FloatArray:
    if not stored:
        return depth_table_mm(None)
    offset_per_mm, step_per_mm, rounding_mm = stored
    steps = DepthSteps(offset_per_mm=offset_per_mm, step_per_mm=step_per_mm, rounding_mm=rounding_mm, agreement=1.0)
    return depth_table_mm(steps)
