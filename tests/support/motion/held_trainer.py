"""A trainer that finishes when the test lets it."""

from engine.motion.learning.trainer import InlineTrainer


class HeldTrainer(InlineTrainer):
    """Finishes a job when the test requests it."""

    def __init__(self):
        super().__init__()
        self.job = None

    def start(self, job):
        self.job = job

    @property
    def is_busy(self):
        return self.job is not None or super().is_busy

    def finish(self):
        job, self.job = self.job, None
        super().start(job)
