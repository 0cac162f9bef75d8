"""An engine's process on frames in real time that are all good.

Run: ``python -m tests.support.engine_process.real_time_program``.

Its line is a receiver in a process of its own, at the path that ``ENGINE_TEST_LINE`` names.
"""

import os
from dataclasses import replace
from pathlib import Path

from engine.core.warmth import Warmth
from service.engine_host import local_engine
from service.engine_host.local_engine import LocalEngine, LoopEngine
from service.engine_host.process.__main__ import main
from tests.support.beam.datagram_line import DatagramBeamLine
from tests.support.control.loop_bench import RecordingPipeline
from tests.support.control.real_time_source import PacedSource

LINE = "ENGINE_TEST_LINE"
REPLY_MS = 500.0


class PacedPipeline(RecordingPipeline):
    """Answers what an engine is asked, too."""

    def activate(self, _model):
        self.calls.append("activate")


def _pipeline(_calibration, _measuring, clock, _trainer, *, learns_after):
    assert learns_after, "a frame is learned from once the gate has decided"
    return PacedPipeline(clock)


def _line(_settings, clock):
    return DatagramBeamLine(Path(os.environ[LINE]), clock, reply_ms=REPLY_MS)


def _without_model(status):
    """What a scripted pipeline calls its model is none that could be stored."""
    return replace(status, learning=replace(status.learning, model=None))


def spoil() -> None:
    """Let engines of this process be such ones."""
    LocalEngine._source = lambda self, _plan: (PacedSource(self._clock), Warmth(0.0))
    local_engine.Pipeline = _pipeline
    local_engine.make_beam_line = _line
    with_model = LoopEngine.status.fget
    LoopEngine.status = property(lambda self: _without_model(with_model(self)))


if __name__ == "__main__":
    spoil()
    main()
