"""Frames from before the first model, of which a reference is proposed as soon as that model is in use.

The pipeline keeps ten frames a second while there is no model, also during the fit. Behind the fit, the trainer's
thread measures those of the training as live frames are, and feeds them to the positions that are proposed: the same
rules hold for both. The few of the fit itself follow in the pipeline's thread, some with each live frame, so that no
gap remains before the first frame that the model measures. The result depends on the frames alone, not on how long the
fit took: a session replays from its tape.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.reference_proposals import MAX_AGE_US, MAX_GAP_US, PastMotion, ReferenceProposals
from engine.motion.learning.still_stretch import STEP_US, Place, place_of
from engine.motion.learning.training_set import TrainingFrame, Vertices

FOLLOWED_AT_ONCE = 3
"""Past frames that are measured with a live one: each takes about a millisecond, and ten a second arrive."""


class Stretch(NamedTuple):
    """Frames without a gap or a movement between them; ``number`` counts the stretches."""

    number: int = 0
    frames: tuple[TrainingFrame, ...] = ()


class PastFrames:
    """Keeps the last frames in which the patient lay still; owned by the pipeline's thread."""

    def __init__(self, vertices: Vertices) -> None:
        self._vertices = vertices
        self._place: Place | None = None
        self.stretch = Stretch()

    def is_due(self, timestamp_us: int) -> bool:
        """Return whether a frame of this time is kept; it has to be sampled as finely as a training frame."""
        frames = self.stretch.frames
        return not frames or not 0 <= timestamp_us - frames[-1].timestamp_us < STEP_US

    def add(self, frame: TrainingFrame) -> None:
        """Keep a frame that is due; a gap or a movement drops those before it."""
        place, now_us = place_of(frame, self._vertices), frame.timestamp_us
        last_us = self.stretch.frames[-1].timestamp_us if self.stretch.frames else now_us - 1
        if not 0 < now_us - last_us <= MAX_GAP_US or (self._place is not None and not place.is_near(self._place)):
            self.clear()
        self._place = self._place or place
        kept = tuple(one for one in self.stretch.frames if now_us - one.timestamp_us <= MAX_AGE_US)
        self.stretch = self.stretch._replace(frames=(*kept, frame))

    def clear(self) -> None:
        """Drop all frames: the patient or the camera may be elsewhere."""
        self._place = None
        self.stretch = Stretch(number=self.stretch.number + 1)


class PastBreaths:
    """Finds the positions of past frames; owned by one thread at a time."""

    def __init__(self, active: PreparedModel, measure: Callable[[TrainingFrame], PastMotion | None]) -> None:
        self._active, self._measure = active, measure
        self._followed = Stretch()
        self.proposals = ReferenceProposals()

    def follow(self, stretch: Stretch, most: int | None = None) -> bool:
        """Follow the frames that were not yet, ``most`` of them; return whether none is left.

        Those before a gap or a movement are forgotten.
        """
        if stretch.number != self._followed.number:
            self.proposals.clear()
            self._followed = Stretch(number=stretch.number)
        since_us = self._followed.frames[-1].timestamp_us if self._followed.frames else -math.inf
        waiting = [frame for frame in stretch.frames if frame.timestamp_us > since_us]
        for frame in waiting[:most]:
            measured = self._measure(frame)
            if measured is not None:
                self.proposals.follow(
                    self._active, measured.coefficients, measured.motion, measured.breath, frame.timestamp_us
                )
                self.proposals.measured_from = measured.reference
            self._followed = self._followed._replace(frames=(frame,))
        return len(waiting) <= len(waiting[:most])
