"""An engine's process that plays recordings as fast as it can.

Run: ``python -m tests.support.engine_process.fast_recording_program``.
"""

from engine.capture.recording_source import OniFileSource
from service.engine_host.local_engine import LocalEngine
from service.engine_host.process.__main__ import main


def _unpaced(self, path, _player):
    return OniFileSource(path, clock=self._clock, is_paced=False)


if __name__ == "__main__":
    LocalEngine._player = _unpaced
    main()
