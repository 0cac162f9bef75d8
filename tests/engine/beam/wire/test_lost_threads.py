"""A wired line one of whose own threads has died is held and latched: half of its supervision is gone."""

import threading
import time

import pytest

from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import NS_PER_MS, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from tests.support.waiting import eventually

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
PATIENCE_S = 10.0


class ObedientWire:
    """Does as requested; its thread can be ended inside of it."""

    name = "an obedient wire"

    def __init__(self) -> None:
        self.is_deadly = self.is_commanded_on = False

    def connect(self) -> None:
        """Always there."""

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:  # noqa: ARG002
        if self.is_deadly:
            raise SystemExit
        self.is_commanded_on = is_on
        return is_on

    def close(self) -> None:
        """Nothing is held."""


@pytest.fixture
def lit():
    """A line that is permitted and reads on, and its wire."""
    wire = ObedientWire()
    line = WiredBeamLine(wire, MonotonicClock())
    line.open()
    _eventually(lambda: _rearms(line))
    _eventually(lambda: _permitted_and_on(line, _lease()))
    yield line, wire
    line.close()


def _rearms(line) -> bool:
    try:
        line.rearm()
    except BeamLineError:
        return False
    return True


_sequence = iter(range(1, 1_000_000))


def _lease() -> Lease:
    now_ns = time.monotonic_ns()
    return Lease(granted_ns=now_ns, expires_ns=now_ns + 200 * NS_PER_MS, sequence=next(_sequence))


def _permitted_and_on(line, lease) -> bool:
    line.permit(lease)
    return line.is_on()


def _eventually(condition) -> None:
    eventually(condition, within_s=PATIENCE_S)


def _end(name, kill) -> None:
    thread = next(thread for thread in threading.enumerate() if thread.name == name)
    kill()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def _kill_watch(line, monkeypatch) -> None:
    def die():
        raise SystemExit

    _end("tidegate-beam-watch", lambda: monkeypatch.setattr(line, "watch_once", die))


def test_a_line_without_its_supervising_thread_is_latched_when_polled(lit, monkeypatch):
    line, wire = lit
    troubles = []
    line.on_trouble = lambda reason, detail: troubles.append((reason, detail))
    _kill_watch(line, monkeypatch)
    with pytest.raises(BeamLineError, match="a thread of the beam line has died: tidegate-beam-watch"):
        line.is_on()
    assert troubles == [(HoldReason.BEAM_LINE_FAILED, "a thread of the beam line has died: tidegate-beam-watch")]
    with pytest.raises(BeamLineError):
        line.permit(_lease())
    _eventually(lambda: not wire.is_commanded_on)


def test_it_is_never_armed_again_until_it_was_opened_again(lit, monkeypatch):
    line, _ = lit
    _kill_watch(line, monkeypatch)
    for _ in range(3):
        with pytest.raises(BeamLineError, match="a thread of the beam line has died"):
            line.rearm()
    monkeypatch.undo()
    line.close()
    line.open()
    _eventually(lambda: _rearms(line))


def test_a_line_without_its_exchange_thread_is_latched_and_reported_at_arming(lit):
    """Its silence may be found first: then that is the cause on show, and who arms is reported what is behind it."""
    line, wire = lit
    _end("tidegate-beam-line", lambda: setattr(wire, "is_deadly", True))
    with pytest.raises(BeamLineError):
        line.is_on()
    with pytest.raises(BeamLineError, match="a thread of the beam line has died: tidegate-beam-line"):
        line.rearm()
    wire.is_deadly = False
