"""An engine's process on frames in real time that are all good: ``python -m tests.engine_process.paced``.

Its line is a receiver in a process of its own, at the path that ``ENGINE_TEST_LINE`` names.
"""

import os
from pathlib import Path

from engine.beam.datagram import DatagramBeamLine
from service import engine_adapter
from service.engine_adapter import EngineAdapter, LoopEngine
from service.engine_process.__main__ import main
from tests.loop.fakes import ToldPipeline
from tests.loop.paced import PacedSource

LINE = "ENGINE_TEST_LINE"
REPLY_MS = 500.0


class PacedPipeline(ToldPipeline):
    """Answers what an engine is asked, too."""

    likeness = None

    def activate(self, _model):
        self.calls.append("activate")


def _pipeline(_calibration, _measuring, clock, _trainer):
    return PacedPipeline(clock)


def _line(_settings, clock):
    return DatagramBeamLine(Path(os.environ[LINE]), clock, reply_ms=REPLY_MS)


def spoil() -> None:
    """Let engines of this process be such ones."""
    EngineAdapter._source = lambda self, _plan: PacedSource(self._clock)
    engine_adapter.Pipeline = _pipeline
    engine_adapter.make_beam_line = _line
    LoopEngine.model = None  # what a scripted pipeline calls its model is none that could be stored


if __name__ == "__main__":
    spoil()
    main()
