"""A run that is asked to end early tells what it has, and a Ctrl-C reaches no one but the run."""

import os
import signal
import time

import pytest

from verification.load import __main__ as command
from verification.load.interruption import Ending
from verification.load.programs import LoadProgram

pytestmark = pytest.mark.waiting


@pytest.fixture
def ending():
    ending = Ending()
    with ending.installed():
        yield ending


def signal_oneself(number):
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_waiting_once_there_is_something_to_tell(ending, number):
    ending.measuring()
    begun_s = time.monotonic()
    signal_oneself(number)
    ending.sleep(600.0)
    assert ending.is_asked
    assert time.monotonic() - begun_s < 300.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_anything_is_measured_leaves_at_once(ending, number):
    with pytest.raises(KeyboardInterrupt):
        signal_oneself(number)


def test_a_second_signal_leaves_at_once(ending):
    ending.measuring()
    signal_oneself(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal_oneself(signal.SIGTERM)


def test_signals_are_given_back():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with Ending().installed():
        assert signal.getsignal(signal.SIGTERM) != before[1]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_run_that_has_measured_nothing_states_it(monkeypatch, capsys):
    monkeypatch.setattr(command, "run", lambda _load, _tell, _ending: signal_oneself(signal.SIGINT))
    assert command.main([]) == command.INTERRUPTED
    assert "before there were figures" in capsys.readouterr().err


def test_a_program_that_makes_load_is_out_of_ctrl_c_s_way():
    with LoadProgram(
        "verification.load.callers", {"per_s": 0.0, "export": None, "session_id": "x", "port": 1}
    ) as program:
        assert os.getpgid(program._process.pid) != os.getpgid(0)
