"""An engine's process that plays recordings four times as fast as they were taken, and waits while it learns.

Run: ``python -m tests.support.engine_process.fast_recording_program``.
"""

from engine.motion.training_process.process_trainer import TrainingProcess
from service.engine_host.local_engine import LocalEngine
from service.engine_host.process.__main__ import main
from tests.support.capture.hurried_source import HurriedSource


def _hurried(self, path, _player):
    return HurriedSource(path, clock=self._clock)


def _watched(run):
    def watched(process, jobs):
        HurriedSource.is_learning.set()
        try:
            return run(process, jobs)
        finally:
            HurriedSource.is_learning.clear()

    return watched


if __name__ == "__main__":
    LocalEngine._player = _hurried
    TrainingProcess.run = _watched(TrainingProcess.run)
    main()
