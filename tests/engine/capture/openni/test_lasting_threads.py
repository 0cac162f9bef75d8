"""Who calls the runtime does so on a thread that never ends: it asks about ended threads, and dies of the answer."""

import threading

import pytest

from engine.capture.openni import c_api
from engine.capture.openni.c_api import call_on_lasting_thread, run_on_lasting_thread
from engine.capture.openni.source import list_devices

pytestmark = pytest.mark.alone


def on_a_thread_that_ends(work):
    results = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    thread.join(60.0)
    assert results, "the call did not come back"
    return results[0]


def test_a_call_is_made_on_a_thread_that_outlives_its_caller():
    used = on_a_thread_that_ends(lambda: call_on_lasting_thread(threading.current_thread))
    assert used.is_alive()
    assert used.name == "openni-capture"


def test_a_lasting_thread_calls_directly_and_does_not_wait_for_another():
    def nested():
        return threading.current_thread(), call_on_lasting_thread(threading.current_thread)

    outer, inner = call_on_lasting_thread(nested)
    assert outer is inner


def test_what_the_call_raises_is_the_callers():
    def fail():
        msg = "no such thing"
        raise OSError(msg)

    with pytest.raises(OSError, match="no such thing"):
        call_on_lasting_thread(fail)
    assert call_on_lasting_thread(lambda: 5) == 5


def test_every_call_of_the_runtime_is_made_so(monkeypatch):
    threads = []

    class Library:
        def __getattr__(self, name):
            def function(*_arguments):
                threads.append(threading.current_thread())
                return b"broken" if name == "oniGetExtendedError" else 1

            return function

    runtime = c_api.Runtime(Library())
    for name in c_api._SIGNATURES:
        on_a_thread_that_ends(getattr(runtime, name))
    assert {thread.name for thread in threads} == {"openni-capture"}
    assert all(thread.is_alive() for thread in threads)
    runtime.oniInitialize(1)
    assert runtime.last_error() == "broken"


def test_the_real_runtime_survives_callers_that_have_ended():
    for _ in range(60):
        on_a_thread_that_ends(list_devices)


@pytest.mark.parametrize("error", [SystemExit, KeyboardInterrupt, RuntimeError], ids=lambda one: one.__name__)
def test_nothing_that_is_raised_ends_the_thread(error):
    """Not even what no one catches: the runtime would crash the process when it asks about the thread."""
    used = []

    def work():
        used.append(threading.current_thread())
        raise error

    assert run_on_lasting_thread(work).wait(20.0)
    assert on_a_thread_that_ends(lambda: call_on_lasting_thread(lambda: 5)) == 5
    assert used[0].is_alive()
