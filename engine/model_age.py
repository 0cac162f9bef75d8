"""For how long the model in use was measured with, by the host's clock, since it was learned or found alike."""

from collections.abc import Iterable

from engine.clock import NS_PER_S
from engine.limits import GateLimits
from engine.model import MotionModel
from engine.notices import LearningNotice, NoticeKind
from engine.permits import HoldReason
from engine.stages.gate import Interruption

NS_PER_MIN = 60 * NS_PER_S


class ModelAge:
    """Follows the news of the learning; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._model: MotionModel | None = None
        self._since_ns = 0
        self._ready_ns: int | None = None

    def look(self, model: MotionModel | None, notices: Iterable[LearningNotice], now_ns: int) -> Interruption | None:
        """Return the hold where the model is too old; one that waited to take over was learned before it waited."""
        if model is not self._model:
            self._model, self._since_ns = model, now_ns
        for notice in notices:
            self._hear(notice, now_ns)
        age_min = (now_ns - self._since_ns) / NS_PER_MIN
        if model is None or age_min <= self._limits.max_model_age_min:
            return None
        detail = f"learned or compared {age_min:.0f} min ago, {self._limits.max_model_age_min:g} allowed"
        return Interruption(HoldReason.MODEL_OLD, detail)

    def _hear(self, notice: LearningNotice, now_ns: int) -> None:
        match notice.kind:
            case NoticeKind.READY:
                self._ready_ns = now_ns
            case NoticeKind.SWAPPED:
                self._since_ns = now_ns if self._ready_ns is None else self._ready_ns
                self._ready_ns = None
            case NoticeKind.COMPARED if notice.figures.get("is_accepted"):
                self._since_ns = now_ns
