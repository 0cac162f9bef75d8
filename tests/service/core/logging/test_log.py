"""The log: one object or one line for each record, whatever was put into it, and no one waits for who reads it."""

import io
import json
import logging
import os
import threading
from contextvars import copy_context

import pytest

from service.core.current_request import begin_request, begin_session
from service.core.logging.nonblocking import NonblockingHandler, dropped_lines
from service.core.logging.redaction import FIELDS, JsonFormatter, RedactingFormatter, in_one_line, install_private_log
from tests.support.waiting import eventually

NASTY = [
    "a\nb",
    "a\r\n2026-11-22 CRITICAL service forged",
    "\x1b[2J\x1b[31mred",
    "\u2028line\u2029",
    "\u202egnp.exe",
    "nul\x00",
    "\x85next\x9b",
    "lone \udce9 surrogate",
    '"},{"level":"critical"}',
]


def record_of(message, *args, level=logging.WARNING, **attributes):
    record = logging.LogRecord("service.test", level, __file__, 1, message, args, None)
    for name, value in attributes.items():
        setattr(record, name, value)
    return record


@pytest.fixture
def _loggers_as_before():
    root = logging.getLogger()
    kept = root.handlers[:], root.level, [(name, logging.getLogger(name).level) for name in ("service", "engine")]
    yield
    for handler in root.handlers:
        if handler not in kept[0]:
            root.removeHandler(handler)
    root.handlers[:] = kept[0]
    root.setLevel(kept[1])
    for name, level in kept[2]:
        logging.getLogger(name).setLevel(level)


def test_a_line_states_when_how_bad_who_and_what():
    said = json.loads(JsonFormatter().format(record_of("%d frames lost", 3, created=1_763_800_000.1239)))
    assert said == {
        "ts": "2025-11-22T08:26:40.123Z",
        "level": "warning",
        "logger": "service.test",
        "message": "3 frames lost",
    }


def test_a_line_states_which_request_and_which_session_it_belongs_to():
    def reported():
        begin_request("mine", "/healthz")
        begin_session("0" * 32)
        return JsonFormatter().format(record_of("done")), RedactingFormatter("%(message)s").format(record_of("done"))

    as_json, as_text = copy_context().run(reported)
    said = json.loads(as_json)
    assert (said["request_id"], said["session_id"], as_text) == ("mine", "0" * 32, "done [mine]")


def test_a_process_that_is_there_for_a_session_states_it_on_every_line():
    assert json.loads(JsonFormatter("1" * 32).format(record_of("done")))["session_id"] == "1" * 32


def test_an_exception_is_reported_by_kind_and_place_alone():
    try:
        try:
            int("P-0001")
        except ValueError as error:
            raise KeyError("P-0001") from error
    except KeyError as error:
        text = JsonFormatter().format(record_of("it failed", exc_info=(type(error), error, error.__traceback__)))
    said = json.loads(text)
    assert said["exception"] == ["builtins.KeyError", "builtins.ValueError"]
    assert "test_log.py" in said["trace"]
    assert "P-0001" not in said["message"] + "".join(said["exception"])


@pytest.mark.parametrize("nasty", NASTY, ids=ascii)
def test_whatever_is_logged_stays_on_its_line(nasty):
    for form in (JsonFormatter(), RedactingFormatter("%(message)s")):
        line = form.format(record_of("the name %s is taken", nasty))
        assert len(line.splitlines()) == 1
        assert all(character.isprintable() for character in line)
        line.encode("utf-8")
    assert json.loads(JsonFormatter().format(record_of("%s", nasty)))["level"] == "warning"


def test_what_is_too_long_is_cut():
    assert len(in_one_line("x" * 100_000)) < 5_000


def test_fields_stand_beside_the_message():
    said = json.loads(JsonFormatter().format(record_of("GET", **{FIELDS: {"status": 200, "route": "/healthz"}})))
    assert (said["status"], said["route"]) == (200, "/healthz")


@pytest.mark.usefixtures("_loggers_as_before")
def test_a_site_s_level_is_for_our_own_loggers_and_libraries_stay_quiet():
    stream = io.StringIO()
    install_private_log("debug", "json", handler=logging.StreamHandler(stream))
    logging.getLogger("service.anything").debug("ours")
    logging.getLogger("httpx").info("GET https://idp.example/?code=secret")
    logging.getLogger("httpx").warning("theirs")
    assert [json.loads(line)["message"] for line in stream.getvalue().splitlines()] == ["ours", "theirs"]


@pytest.mark.usefixtures("_loggers_as_before")
def test_a_stopped_reader_blocks_no_caller_and_dropped_lines_are_counted():
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as stream:
        handler = NonblockingHandler(stream, most_lines=16)
        install_private_log(handler=handler)
        logger = logging.getLogger("service.anything")
        done = threading.Event()

        def log():
            for number in range(2_000):
                logger.warning("line %d %s", number, "x" * 500)
            done.set()

        threading.Thread(target=log, daemon=True).start()
        assert done.wait(10.0), "logging waited for the pipe's reader"
        assert dropped_lines() > 1_000
        os.set_blocking(reading, False)
        eventually(lambda: _empties(reading))
        os.close(reading)


def _empties(reading):
    """Read on; true once nothing has come for a while, so that the writing thread is free."""
    try:
        return os.read(reading, 1 << 20) == b""
    except BlockingIOError:
        return True


def test_lines_come_out_in_order_and_the_end_waits_for_them():
    stream = io.StringIO()
    handler = NonblockingHandler(stream)
    for number in range(100):
        handler.emit(record_of("%d", number))
    handler.flush()
    assert stream.getvalue().split() == [str(number) for number in range(100)]


def test_a_reader_that_has_gone_breaks_nothing():
    reading, writing = os.pipe()
    os.close(reading)
    stream = os.fdopen(writing, "w")
    handler = NonblockingHandler(stream)
    handler.emit(record_of("lost"))
    handler.flush()
    handler.emit(record_of("lost too"))
    handler.flush()
    with pytest.raises(BrokenPipeError):
        stream.close()
