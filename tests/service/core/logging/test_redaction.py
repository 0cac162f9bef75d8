"""The log tells what failed and where, and never what it was about."""

import io
import logging
import sys
import threading

import pytest
from fastapi import FastAPI

from service.core.logging.redaction import RedactingFormatter, install_private_log, trace_of
from service.web.server import make_server

SECRET = "ZZPATIENTZZ"


def fail(text: str) -> None:
    raise ValueError(text)


SERVERS = ("uvicorn", "uvicorn.error", "uvicorn.access")


@pytest.fixture
def plain_servers(monkeypatch):
    """The web server's loggers as a new process has them: a server that another test ran has given them its own."""
    for name in SERVERS:
        monkeypatch.setattr(logging.getLogger(name), "handlers", [])
        monkeypatch.setattr(logging.getLogger(name), "propagate", True)
        monkeypatch.setattr(logging.getLogger(name), "disabled", False)


@pytest.fixture
def written(plain_servers):
    kept = logging.root.handlers[:], logging.root.level, sys.excepthook, threading.excepthook
    install_private_log()
    stream = io.StringIO()
    logging.root.handlers[0].setStream(stream)
    yield stream
    logging.root.handlers[:], sys.excepthook, threading.excepthook = kept[0], kept[2], kept[3]
    logging.root.setLevel(kept[1])


def test_an_exception_is_reported_by_its_kind_and_its_place(written):
    try:
        fail(SECRET)
    except ValueError:
        logging.getLogger("uvicorn.error").exception("Exception in ASGI application\n")
    assert "builtins.ValueError (message left out)" in written.getvalue()
    assert "in fail" in written.getvalue()
    assert SECRET not in written.getvalue()


def test_so_are_those_behind_it():
    def chain():
        try:
            fail(SECRET)
        except ValueError as error:
            raise KeyError(SECRET) from error

    with pytest.raises(KeyError) as caught:
        chain()
    reported = trace_of(caught.value)
    assert reported.index("KeyError") < reported.index("ValueError")
    assert SECRET not in reported


def test_an_exception_that_behind_it_is_itself_ends_somewhere():
    first, second = ValueError(SECRET), KeyError(SECRET)
    first.__context__, second.__context__ = second, first
    assert SECRET not in trace_of(first)


def test_a_trace_that_another_handler_has_written_is_not_taken_over():
    record = logging.LogRecord("x", logging.ERROR, "", 0, "it failed", None, None)
    record.exc_text = f"Traceback: {SECRET}"
    assert SECRET not in RedactingFormatter().format(record)


def test_what_the_event_loop_reports_a_task_is_cut_to_its_first_line(written):
    logging.getLogger("asyncio").error("Task exception was never retrieved\nfuture: <Task exception=%r>", SECRET)
    assert "never retrieved" in written.getvalue()
    assert SECRET not in written.getvalue()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_fails_is_reported_without_its_message(written):
    thread = threading.Thread(target=fail, args=(SECRET,), name="tidegate-writer")
    thread.start()
    thread.join()
    assert "the thread tidegate-writer failed" in written.getvalue()
    assert SECRET not in written.getvalue()


def test_an_uncaught_error_is_logged_without_its_message(written):
    try:
        fail(SECRET)
    except ValueError:
        sys.excepthook(*sys.exc_info())
    assert "Tidegate failed" in written.getvalue()
    assert SECRET not in written.getvalue()


def test_the_web_server_has_no_log_of_its_own(written):
    make_server(FastAPI(), host="127.0.0.1", port=0)
    for name in SERVERS:
        found = logging.getLogger(name)
        assert found.handlers == [], name
    assert logging.getLogger("uvicorn.error").propagate
