"""An engine's process that plays recordings four times as fast as they were taken.

Run: ``python -m tests.support.engine_process.fast_recording_program``.
"""

from service.engine_host.local_engine import LocalEngine
from service.engine_host.process.__main__ import main
from tests.support.capture.hurried_source import HurriedSource


def _hurried(self, path, _player):
    return HurriedSource(path, clock=self._clock)


if __name__ == "__main__":
    LocalEngine._player = _hurried
    main()
