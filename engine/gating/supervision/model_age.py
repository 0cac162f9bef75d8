"""Age of the model in use, by the host's clock, since it was trained or compared with the patient."""

from collections.abc import Iterable

from engine.core.clock import NS_PER_S
from engine.core.gate_state import HoldReason
from engine.core.learning_events import LearningEvent, LearningEventKind
from engine.core.motion_model import MotionModel
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits

NS_PER_MIN = 60 * NS_PER_S


class ModelAge:
    """Follows the learning events; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._model: MotionModel | None = None
        self._since_ns = 0
        self._ready_ns: int | None = None

    def check(self, model: MotionModel | None, notices: Iterable[LearningEvent], now_ns: int) -> Interruption | None:
        """Return the hold for a model that is too old; the age of one that waited counts from its training."""
        if model is not self._model:
            self._model, self._since_ns = model, now_ns
        for notice in notices:
            self._note(notice, now_ns)
        age_min = (now_ns - self._since_ns) / NS_PER_MIN
        if model is None or age_min <= self._limits.max_model_age_min:
            return None
        detail = f"trained or compared {age_min:.0f} min ago, {self._limits.max_model_age_min:g} allowed"
        return Interruption(HoldReason.MODEL_OLD, detail)

    def _note(self, notice: LearningEvent, now_ns: int) -> None:
        match notice.kind:
            case LearningEventKind.READY:
                self._ready_ns = now_ns
            case LearningEventKind.SWAPPED:
                self._since_ns = now_ns if self._ready_ns is None else self._ready_ns
                self._ready_ns = None
            case LearningEventKind.COMPARED if notice.figures.get("is_accepted"):
                self._since_ns = now_ns
