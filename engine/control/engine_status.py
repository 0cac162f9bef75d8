"""What is known of a running engine, as one value: published by the engine thread, read by any other."""

from dataclasses import dataclass, field

from engine.capture.source import SourceDescription
from engine.control.countersignature import CountersignatureState
from engine.control.outputs import LiveView, LoopStatus
from engine.core.learning_status import LearningStatus
from engine.core.ranges import Ranges


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EngineStatus:
    """The state of an engine at the end of its last turn, or at its last answer to a command.

    Attributes
    ----------
    run_state
        Starting, running, ended or failed.
    error
        Why it failed, for a person; None where it did not.
    source
        The camera or recording, once it is open.
    view
        The newest view; None before the first frame.
    learning
        The model and the reference in use.
    predicted_duty_percent
        Share of the learned breaths inside the window, 0 to 100; None where it is not known, and for breath holds.
    learned_ranges
        Range of each signal of the window in the training, against the present reference; for display alone.
    arming_state
        Hash of what an arming would take: window, its correction and times, reference, model and head direction.
    is_reason_needed
        Whether a person has to arm, with a reason: conditions joined by or, or a window beyond the fraction's budget.
    countersignature
        Whether the next arming needs a second person, and who has signed what it would take.
    """

    run_state: LoopStatus = LoopStatus.STARTING
    error: str | None = None
    source: SourceDescription | None = None
    view: LiveView | None = None
    learning: LearningStatus = field(default_factory=LearningStatus)
    predicted_duty_percent: float | None = None
    learned_ranges: Ranges = field(default_factory=dict)
    arming_state: str = ""
    is_reason_needed: bool = False
    countersignature: CountersignatureState = field(default_factory=CountersignatureState)

    @property
    def is_over(self) -> bool:
        """Whether the engine decides nothing any more."""
        return self.run_state.is_over
