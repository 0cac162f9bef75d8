"""A service process that has much to end.

Run: ``python -m tests.support.service.shutdown_program DATA RECORDINGS PORT ROWS HANG_S``.

Its engine has measured ROWS frames as fast as they are taken, and goes on with thirty a second; asked to stop it tells
``held NS`` in host monotonic time, after HANG_S, as an engine does whose beam line does not answer.
"""

import os
import sys
import threading
import time
from pathlib import Path

from engine.control.outputs import LoopStatus
from engine.core.gate_state import GateState, HoldReason
from service.core.logging.nonblocking import NonblockingHandler
from service.core.logging.redaction import install_private_log
from service.core.settings.settings import Settings
from service.web.app import create_app
from service.web.server import make_server
from service.web.shutdown import leave_at_once
from tests.support.service.fake_engine import FakeEngine, FakeRunning

FRAME_S = 1 / 30
MOST_WAITING = 600


def tell(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


class StubbornRunning(FakeRunning):
    """Holds on request to, and takes its time; then ends, as one that hung."""

    hang_s = 0.0

    def stop(self) -> None:
        self.transition(GateState.HOLD, HoldReason.ENGINE_STOPPED)
        if self.hang_s:
            time.sleep(self.hang_s)
            self.run_state, self.error = LoopStatus.FAILED, "the engine did not stop in time; the beam is held"
        else:
            self.run_state = LoopStatus.ENDED
        tell("held", time.monotonic_ns())


class BusyEngine(FakeEngine):
    """Sessions begin with many rows."""

    def __init__(self, rows: int, hang_s: float) -> None:
        super().__init__()
        self._rows = rows
        self._hang_s = hang_s

    def open(self, plan):
        running = StubbornRunning(plan)
        running.hang_s = self._hang_s
        threading.Thread(target=_drive, args=(running, self._rows), daemon=True).start()
        return running


def _drive(running: FakeRunning, rows: int) -> None:
    for _ in range(rows):
        while running.samples.qsize() > MOST_WAITING:
            time.sleep(0.005)
        running.frame()
    tell("driven", rows)
    running.transition(GateState.BEAM_ON)
    while not running.status.is_over:
        running.frame()
        time.sleep(FRAME_S)


def main() -> None:
    data, recordings, port, rows, hang_s = sys.argv[1:]
    settings = Settings(
        data_dir=Path(data), recordings_dirs=(Path(recordings),), port=int(port), max_live_clients=256, log_level="info"
    )
    install_private_log(settings.log_level, "json", handler=NonblockingHandler())
    app = create_app(settings, lambda _settings: BusyEngine(int(rows), float(hang_s)))
    make_server(app, host=settings.host, port=settings.port, leave=os._exit).run()
    leave_at_once()


if __name__ == "__main__":
    main()
