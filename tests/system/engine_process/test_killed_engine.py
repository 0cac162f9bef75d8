"""An engine's process that is killed, stopped or hangs, and a service's side that falls silent: the receiver judges."""

import signal
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from engine.control.journal.format import read_journal
from engine.control.outputs import LoopStatus
from engine.core.commands import ActivateModel, Arm, Disarm, HoldBeam, ReleaseBeam, SetReference
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from service.core.errors import BoundError
from service.core.schemas.windows import Window
from service.engine_host.process.channels import SLOTS
from service.storage.files.journals import Journals, read_unless_in_use
from tests.support.beam.receivers import Lateness
from tests.support.engine_process.bench import (
    MS,
    PATIENT,
    SILENCE_MS,
    WINDOW,
    bench,
    eventually,
    is_there,
    line_at,
    make_plan,
)

pytestmark = pytest.mark.waiting

LARGE_MODEL = np.zeros((100, 350, 200), np.float32)
TRIES = 5
LEASE_NS = int(PATIENT["lease_ms"] * MS)


@pytest.fixture
def line(tmp_path):
    with line_at(tmp_path / "line") as held:
        yield held


@pytest.fixture(scope="module")
def lateness():
    with Lateness() as held:
        yield held


@pytest.fixture(scope="module")
def lasting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lasting")
    with line_at(folder / "line") as far, bench(folder, far, max_unwritten_ms=600.0) as held:
        yield held


@pytest.fixture
def held(lasting):
    """One engine's process for all tests that leave it alive; no one is armed."""
    eventually(lambda: lasting.engine.status.view is not None)
    lasting.calm()
    return lasting


def held_after(held, begin: Callable[[], object], reasons: set[HoldReason]) -> tuple[int, int]:
    """Turn the beam on and begin what holds it; return when [ns] that began, and when the receiver saw the hold.

    On a busy machine the lease may lapse first, or a frame be late, which is safe and proves nothing: then once more.
    """
    for _ in range(TRIES):
        held.turn_on()
        begin()
        began_ns = time.monotonic_ns()
        edge, *times_ns = held.line.await_off()
        eventually(lambda: held.engine.status.view.record.hold_reason is not None)
        if edge == "held" and held.engine.status.view.record.hold_reason in reasons:
            return began_ns, int(times_ns[0])
        held.calm()
    pytest.fail(f"the beam went off for another reason {TRIES} times")


def test_a_session_in_a_process_of_its_own_turns_the_beam_on_obeys_and_ends(tmp_path, line):
    with bench(tmp_path, line) as held:
        held.turn_on()
        assert held.engine.submit(HoldBeam(operator="ann")).result(5.0) is None
        assert line.await_off()[0] == "held"
        view = held.engine.status.view
        assert (view.record.hold_reason, view.operator_hold) == (HoldReason.OPERATOR_HOLD, "ann")
        frame_index, picture = held.engine.picture()
        assert (frame_index >= 0, picture.shape, picture.flags.writeable) == (True, (4, 6, 3), False)
        pid = held.pid
        held.engine.stop()
        assert (held.engine.status.run_state, held.engine.status.error) == (LoopStatus.ENDED, None)
        assert set(held.engine.evidence()) == {"tape_sha256", "tape_torn"}
        eventually(lambda: not is_there(pid))
        held.take()
        indices = [record.measurement.frame_index for record in held.samples]
        assert indices == list(range(len(indices)))
        numbers = [one.number for one in held.transitions]
        assert numbers == sorted(set(numbers))
        assert held.transitions[-1].to_state is GateState.DISARMED
        held.journal.close()
        assert not held.journal.path.exists()
        with pytest.raises(CommandRefusedError, match="over"):
            held.engine.submit(Disarm(operator="ann"))


def test_an_engine_s_process_that_is_killed_leaves_the_line_off_and_a_session_that_states_it(tmp_path, line, lateness):
    with bench(tmp_path, line) as held:
        held.turn_on()
        pid = held.pid
        killed_ns = held.send(signal.SIGKILL)
        _edge, *times_ns = line.await_off()
        assert int(times_ns[-1]) <= killed_ns + LEASE_NS + lateness.allowed_ns
        eventually(lambda: held.engine.status.run_state is LoopStatus.FAILED)
        assert "signal 9" in held.engine.status.error
        view = held.engine.status.view
        assert (view.is_armed, view.record.gate_state) == (False, GateState.FAULT)
        assert held.engine.evidence()["tape_torn"]
        assert not is_there(pid), "it was buried"
        assert held.journal.is_orphaned
        assert read_unless_in_use(held.journal.path, patience_s=0.0) is not None, "nobody writes to it any more"
        held.journal.close()
        assert held.journal.path.exists(), "what it says is still to be written down"
        assert held.port.processes_lost == 1


def test_an_engine_s_process_that_was_stopped_goes_off_by_itself_shows_as_a_fault_and_goes_on(held, lateness):
    held.turn_on()
    stopped_ns = held.send(signal.SIGSTOP)
    _edge, *times_ns = held.line.await_off()
    assert int(times_ns[-1]) <= stopped_ns + LEASE_NS + lateness.allowed_ns
    eventually(lambda: held.engine.status.view.record.gate_state is GateState.FAULT)
    shown = held.engine.status.view
    assert (shown.is_armed, shown.detail) == (False, "the engine's process does not answer")
    assert held.engine.status.view is shown, "readers tell news by identity"
    held.send(signal.SIGCONT)
    eventually(lambda: held.engine.status.view.detail != shown.detail)
    held.turn_on()


def test_an_engine_that_does_not_stop_on_request_is_killed_and_its_tape_is_torn(tmp_path, line):
    with bench(tmp_path, line) as held:
        held.turn_on()
        pid = held.pid
        held.send(signal.SIGSTOP)
        held.engine.stop()
        assert held.engine.status.run_state is LoopStatus.FAILED
        assert "did not stop" in held.engine.status.error
        assert "did not stop" in held.engine.evidence()["tape_torn"]
        assert not is_there(pid)
        assert not line.is_on


def test_a_silent_service_faults_an_armed_gate_and_no_other(held, lateness):
    held.silence()
    frames = held.engine.status.view.frames
    eventually(lambda: held.engine.status.view.frames > frames + 1.5 * SILENCE_MS / 33.0)
    assert held.engine.status.view.record.gate_state is GateState.DISARMED, "not armed: nothing is held by it"
    held.calm()
    silent_ns, off_ns = held_after(held, held.silence, {HoldReason.SERVICE_SILENT})
    latest_ns = silent_ns + (SILENCE_MS + 60) * MS + lateness.allowed_ns
    assert silent_ns + (SILENCE_MS - 100) * MS <= off_ns <= latest_ns
    held.calm()
    held.turn_on()


def test_a_web_server_that_does_not_turn_is_a_silent_service_though_its_process_beats(held, lateness):
    blocked_ns, off_ns = held_after(held, held.serves.clear, {HoldReason.SERVICE_SILENT})
    latest_ns = blocked_ns + (SILENCE_MS + 90) * MS + lateness.allowed_ns
    assert blocked_ns + (SILENCE_MS - 100) * MS <= off_ns <= latest_ns
    held.calm()
    held.turn_on()


def test_an_arm_that_was_given_up_while_the_process_stood_still_is_not_carried_out_afterwards(held):
    held.send(signal.SIGSTOP)
    asked = held.engine.submit(Arm(operator="late"))
    with pytest.raises(TimeoutError):
        asked.result(0.1)
    asked.cancel()
    held.send(signal.SIGCONT)
    frames = held.engine.status.view.frames
    eventually(lambda: held.engine.status.view.frames > frames + 5)
    assert not held.engine.status.view.is_armed
    assert all(one.operator != "late" for one in held.transitions)


def test_an_arm_that_waited_too_long_is_refused_though_it_was_not_abandoned(held):
    held.send(signal.SIGSTOP)
    asked = held.engine.submit(Arm(operator="late"))
    time.sleep(1.1)
    held.send(signal.SIGCONT)
    with pytest.raises(CommandRefusedError, match="busy for too long"):
        asked.result(5.0)
    assert not held.engine.status.view.is_armed


def test_a_hold_that_was_given_up_is_carried_out_all_the_same(held):
    held.turn_on()
    held.send(signal.SIGSTOP)
    held.engine.submit(HoldBeam(operator="ann")).cancel()
    held.send(signal.SIGCONT)
    eventually(lambda: held.engine.status.view.operator_hold == "ann")


def test_a_writer_that_takes_nothing_holds_the_beam_as_if_it_were_in_the_engine_s_process(held, lateness):
    behind = {HoldReason.RECORDER_BEHIND, HoldReason.AUDIT_BEHIND}
    hung_ns, off_ns = held_after(held, held.writes.clear, behind)
    assert off_ns <= hung_ns + (600 + 60) * MS + 2 * lateness.allowed_ns
    assert not held.engine.samples.empty(), "all had come over, and counted as unwritten"
    held.writes.set()
    held.turn_on()


def test_a_hold_waits_behind_no_model_that_is_on_its_way(held):
    held.turn_on()
    is_free = threading.Event()
    send = held.engine._child.bulk.send
    held.engine._child.bulk.send = lambda message: (is_free.wait(20.0), send(message))
    large = held.engine.submit(ActivateModel(operator="bob", model=LARGE_MODEL))
    assert held.engine.submit(HoldBeam(operator="ann")).result(5.0) is None
    assert held.line.await_off()[0] == "held"
    assert not large.done()
    is_free.set()
    assert large.result(10.0) is None
    held.engine._child.bulk.send = send
    assert not held.engine.status.view.is_armed, "another model disarms"


def test_an_answer_comes_after_what_it_is_about_can_be_read(held):
    held.turn_on()
    for _ in range(10):
        held.engine.submit(HoldBeam(operator="ann")).result(5.0)
        assert held.engine.status.view.operator_hold == "ann"
        held.engine.submit(ReleaseBeam(operator="ann")).result(5.0)
        assert held.engine.status.view.operator_hold is None


def test_more_orders_than_there_are_places_are_refused_at_once(held):
    held.send(signal.SIGSTOP)
    asked = [held.engine.submit(SetReference(operator="ann")) for _ in range(SLOTS)]
    with pytest.raises(CommandRefusedError, match="wait already"):
        held.engine.submit(SetReference(operator="ann"))
    for one in asked:
        one.cancel()
    hold = held.engine.submit(HoldBeam(operator="ann"))
    held.send(signal.SIGCONT)
    assert hold.result(5.0) is None
    eventually(lambda: len(held.engine._free_slots) == SLOTS)
    assert not [one for one in held.transitions if "reference" in one.detail], "none was wanted any more"


def test_a_request_to_a_process_that_dies_fails_with_that_reason(tmp_path, line):
    with bench(tmp_path, line) as held:
        eventually(lambda: held.engine.status.view is not None)
        held.send(signal.SIGSTOP)
        asked = [held.engine.submit(SetReference(operator="ann")) for _ in range(3)]
        held.send(signal.SIGKILL)
        for one in asked:
            with pytest.raises(CommandRefusedError, match="over"):
                one.result(5.0)


def test_a_session_that_cannot_begin_states_why_in_the_engine_s_own_words_and_the_next_can(tmp_path, line):
    with bench(tmp_path, line, window_upper_mm=5.0) as held:
        wide = Window.model_validate({**WINDOW, "upper_mm": 6.0})
        port = held.port
        journal = Journals(tmp_path, tmp_path / "journals").begin("1" * 32)
        with pytest.raises(BoundError, match="at most 5") as refused:
            port.open(make_plan(journal, session_id="1" * 32, window=wide))
        assert (refused.value.field, refused.value.code) == ("window.upper_mm", "invalid_value")
        journal.close()
        assert not journal.path.exists()
        assert port.processes_lost == 0


@pytest.mark.parametrize("way", ["control", "bulk"])
def test_a_process_that_does_not_understand_the_service_holds_before_it_ends(tmp_path, line, lateness, way):
    with bench(tmp_path, line) as held:
        held.turn_on()
        getattr(held.engine._child, way).send(("what", "is this"))
        said_ns = time.monotonic_ns()
        edge, *times_ns = line.await_off()
        assert edge == "held", "by the process itself, not by its lease"
        assert int(times_ns[0]) <= said_ns + lateness.allowed_ns
        eventually(lambda: held.engine.status.run_state is LoopStatus.FAILED)
        kept = read_journal(held.journal.path.read_bytes())
        assert HoldReason.ENGINE_FAILED in [one.transition.reason for one in kept.entries]
