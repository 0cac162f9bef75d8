"""Refits a model that was learned in the session to the present stretch in which the patient lies still.

The first model knows three breaths or so. Ten frames a second of what is measured are kept from the session's start,
and each time the stretch is twice as long as the one the model was learned from, another is fitted to all of it. It
takes over like a retrained one: the reference is transferred, and never while the gate is armed.
"""

from dataclasses import replace

from engine.core.errors import ModelError
from engine.motion.learning.past_frames import StillStretch
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.tasks import FitJob, LearningStages, fit_checked
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.learning.training_set import TrainingFrame

GROWTH = 2.0
"""Least length of a stretch for another model, as a multiple of the one that the present model was learned from."""
LONGEST = 1.25
"""So much longer than the last refit's a stretch may become before its frames are released without one."""
WORTHWHILE = 1.5
"""The same where no other refit follows, because the recording is over."""


class Refits:
    """Keeps frames of the session and says when a better model can be fitted; owned by the pipeline's thread.

    A survey keeps all frames of a recording and refits nothing until its end.
    """

    def __init__(
        self, settings: TrainingSettings, stages: LearningStages, calibration_sha256: str, *, is_survey: bool = False
    ) -> None:
        # Drift and breath holds belong to a long stretch, and its frames were measured.
        self._settings = replace(settings, max_shift_mm=50.0, max_tilt_deg=20.0, max_outlier_share=0.5)
        self._stages, self._calibration_sha256 = stages, calibration_sha256
        self._until_s = settings.refit_until_s
        self.is_survey = is_survey
        self._stretch = StillStretch(settings, stages.vertices)
        self._tried_s = 0.0
        self._is_over = not is_survey and self._until_s == 0.0

    def is_due(self, timestamp_us: int) -> bool:
        """Return whether a frame of this time is kept; it has to be sampled as finely as a training frame."""
        return not self._is_over and self._stretch.is_due(timestamp_us)

    def add(self, frame: TrainingFrame) -> None:
        """Keep a frame that is due; while the gate is armed no refit begins, and the frames must not go on growing."""
        self._stretch.add(frame)
        seconds = self._stretch.present.seconds
        self._tried_s = min(self._tried_s, seconds)  # another stretch has begun
        if not self.is_survey and seconds > LONGEST * self._until_s:
            self._stop()

    def job(self, active: PreparedModel) -> FitJob | None:
        """Return the job that fits another model, if the present stretch has become long enough; else None."""
        seconds = self._stretch.present.seconds
        if self._is_over or self.is_survey or seconds < GROWTH * max(active.model.seconds, self._tried_s):
            return None
        self._tried_s = seconds
        job = FitJob(
            training_set=self._stretch.present.snapshot(),
            stages=self._stages.of_now(),
            settings=self._settings,
            calibration_sha256=self._calibration_sha256,
            before=active,
        )
        if seconds * GROWTH > self._until_s:
            self._stop()
        return job

    def _stop(self) -> None:
        """Keep no more frames, and release those that were kept."""
        self._is_over = True
        self._stretch = StillStretch(self._settings, self._stages.vertices)

    def of_longest(self, first: PreparedModel) -> PreparedModel | None:
        """Return a model of the longest stretch; None where it is hardly longer than the first model's, or refused."""
        longest = self._stretch.longest
        if longest.seconds < WORTHWHILE * first.model.seconds:
            return None
        try:
            active, _ = fit_checked(longest, self._stages.of_now(), self._settings, self._calibration_sha256)
        except ModelError:
            return None
        return replace(active, model=replace(active.model, depth_steps=first.model.depth_steps))


class SessionRefits:
    """The refits of a session: begun with each training, none after a stored model was chosen."""

    def __init__(self, settings: TrainingSettings, stages: LearningStages, calibration_sha256: str) -> None:
        self._settings, self._stages, self._calibration_sha256 = settings, stages, calibration_sha256
        self._refits: Refits | None = None

    def begin(self) -> None:
        """Keep the frames of another training; those of a whole recording are kept on."""
        if self._refits is None or not self._refits.is_survey:
            self._refits = Refits(self._settings, self._stages, self._calibration_sha256)

    def stop(self) -> None:
        """Refit nothing any more."""
        self._refits = None

    def keep_recording(self) -> None:
        """Keep frames of a whole recording, for `of_longest`; refit nothing before its end."""
        self._refits = Refits(self._settings, self._stages, self._calibration_sha256, is_survey=True)

    def is_due(self, timestamp_us: int) -> bool:
        """Whether a frame of this time is kept."""
        return self._refits is not None and self._refits.is_due(timestamp_us)

    def add(self, frame: TrainingFrame) -> None:
        """Keep a frame that is due."""
        if self._refits is not None:
            self._refits.add(frame)

    def job(self, active: PreparedModel) -> FitJob | None:
        """Return the job of a refit that is due; None where none is."""
        return None if self._refits is None else self._refits.job(active)

    def of_longest(self, active: PreparedModel | None) -> PreparedModel | None:
        """Return a model of the longest stretch without movement where that is worthwhile, else ``active``."""
        if self._refits is None or active is None:
            return active
        return self._refits.of_longest(active) or active
