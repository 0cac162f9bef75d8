"""An engine's process that plays recordings as fast as it can: ``python -m tests.engine_process.hurried``."""

from engine.capture.oni_file import OniFileSource
from service.engine_adapter import EngineAdapter
from service.engine_process.__main__ import main


def _unpaced(self, path, _player):
    return OniFileSource(path, clock=self._clock, is_paced=False)


if __name__ == "__main__":
    EngineAdapter._player = _unpaced
    main()
