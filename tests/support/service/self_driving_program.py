"""A service process on an engine that drives itself, to be killed by a test.

Run: ``python -m tests.support.service.self_driving_program``.

Tells each frame and transition *after* it was put into its queue, as ``sample INDEX NS`` or ``transition INDEX NS``, in
host monotonic time, which is the same clock in the test's process.
"""

import contextlib
import json
import os
import sys
import threading
import time
from pathlib import Path

from engine.core.gate_state import GateState, HoldReason
from service.access.request.addresses import LOOPBACK
from service.core.settings.groups import ConnectionLimits
from service.core.settings.settings import Settings
from service.web import server
from service.web.app import create_app
from service.web.server import make_server
from tests.support.service.fake_engine import FakeEngine, FakeRunning

FRAME_S = 1 / 30
LARGEST_BODY = 1_048_576
FRAMES_A_TRANSITION = 10
LIMITS = "SERVICE_TEST_CONNECTION_LIMITS"
"""The environment variable with other limits of connections, as JSON."""


class SelfDrivingEngine(FakeEngine):
    """Thirty frames a second, and a transition at every tenth."""

    def open(self, plan):
        running = super().open(plan)
        threading.Thread(target=_drive, args=(running,), daemon=True).start()
        return running


def tell(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def _drive(running: FakeRunning) -> None:
    transitions = 0
    while not running.status.is_over:
        record = running.frame()
        tell("sample", record.measurement.frame_index, time.monotonic_ns())
        if record.measurement.frame_index % FRAMES_A_TRANSITION == 0:
            state = GateState.BEAM_ON if running.gate is GateState.HOLD else GateState.HOLD
            running.transition(state, HoldReason.OUTSIDE_WINDOW)
            tell("transition", transitions, time.monotonic_ns())
            transitions += 1
        time.sleep(FRAME_S)
    tell("stopped", 0, time.monotonic_ns())


def main() -> None:
    data, recordings, port = sys.argv[1:]
    server.MAX_PLAN_BYTES = LARGEST_BODY  # its bytes on the wire are sent within a test's time
    settings = Settings(data_dir=Path(data), recordings_dirs=(Path(recordings),), port=int(port))
    with contextlib.suppress(KeyboardInterrupt):
        limits = ConnectionLimits(**json.loads(os.environ.get(LIMITS, "{}")))
        app = create_app(settings, lambda _settings: SelfDrivingEngine(), connection_limits=limits)
        make_server(
            app,
            host=settings.host,
            port=settings.port,
            certificate=app.state.certificate,
            connection_limits=limits,
            trusted_proxies=LOOPBACK if settings.behind_proxy else (),
        ).run()


if __name__ == "__main__":
    main()
