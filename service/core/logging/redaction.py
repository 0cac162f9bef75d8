"""Formatters of the service's log: the kind and the place of an error, never its message.

An exception's message may hold a patient's reference, a row's values or a password. So the log shows an exception's
class and traceback and leaves its message out. Code that catches one of our own errors logs a text of its own.

Control characters are escaped, so that a chosen name or path cannot add lines to the log or colours to a terminal.
"""

import json
import logging
import re
import sys
import threading
import traceback
from collections.abc import Mapping
from datetime import UTC, datetime
from types import TracebackType

from service.core.current_request import current_request_id, current_session_id
from service.core.settings.groups import LogFormat

logger = logging.getLogger(__name__)
LINE = "%(asctime)s %(levelname)s %(name)s %(message)s"
OURS = ("service", "engine")
"""Loggers that the site's level applies to; of libraries, only warnings and worse are logged."""
MULTILINE = ("asyncio",)
"""Loggers that put an exception's text on further lines of their message."""
LONGEST_CHAIN = 8
HEAD = "Traceback (most recent call last):\n"
FIELDS = "fields"
"""Attribute of a record with further fields of its JSON line: ``extra={FIELDS: {...}}``."""
LONGEST_MESSAGE = 4000
UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def in_one_line(text: str) -> str:
    """Escape control and bidirectional characters; truncate a text that is too long."""
    cut = text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]}…"
    return UNSAFE.sub(lambda found: ascii(found.group())[1:-1], cut)


class RedactingFormatter(logging.Formatter):
    """Writes records as text, without the messages of exceptions."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record; a trace cached by another formatter is dropped."""
        record.exc_text = None
        text = super().format(record)
        record.exc_text = None
        return text

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the base's name
        """Format the line without its trace, always on one line."""
        record.message = _message_of(record)
        line = super().formatMessage(record)
        request_id = current_request_id()
        return line if request_id is None else f"{line} [{request_id}]"

    def formatException(  # noqa: N802 - the base's name
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None],
    ) -> str:
        """Format an exception's class and traceback."""
        return "" if ei[1] is None else trace_of(ei[1])


class JsonFormatter(logging.Formatter):
    """Writes records as one JSON object a line, for a collector, without the messages of exceptions."""

    def __init__(self, session_id: str | None = None, room: str = "") -> None:
        super().__init__()
        self._session_id = session_id
        self._room = room

    def format(self, record: logging.LogRecord) -> str:
        """Format a record."""
        fields = getattr(record, FIELDS, None)
        entry: dict[str, object] = {
            "ts": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _message_of(record),
            "room": self._room or None,
            "request_id": current_request_id(),
            "session_id": current_session_id() or self._session_id,
            **(fields if isinstance(fields, Mapping) else {}),
        }
        if record.exc_info and record.exc_info[1] is not None:
            entry["exception"] = [_kind(one) for one in _chain(record.exc_info[1])]
            entry["trace"] = trace_of(record.exc_info[1])
        return json.dumps({name: value for name, value in entry.items() if value is not None}, allow_nan=False)


def _message_of(record: logging.LogRecord) -> str:
    text = record.getMessage()
    if record.name.partition(".")[0] in MULTILINE:
        text = text.partition("\n")[0]
    return in_one_line(text.rstrip("\n"))


def trace_of(error: BaseException) -> str:
    """Format the classes and tracebacks of an exception and of its causes."""
    parts = []
    for found in _chain(error):
        frames = "".join(traceback.format_tb(found.__traceback__))
        parts.append(f"{HEAD}{frames}{_kind(found)} (message left out)")
    return "\n\nfrom\n\n".join(parts)


def _chain(error: BaseException) -> list[BaseException]:
    parts: list[BaseException] = []
    found: BaseException | None = error
    while found is not None and len(parts) < LONGEST_CHAIN:
        parts.append(found)
        found = found.__cause__ or (None if found.__suppress_context__ else found.__context__)
    return parts


def _kind(error: BaseException) -> str:
    return f"{type(error).__module__}.{type(error).__qualname__}"


def formatter(form: LogFormat, session_id: str | None = None, room: str = "") -> logging.Formatter:
    """Return the formatter for this format."""
    return JsonFormatter(session_id, room) if form == "json" else RedactingFormatter(LINE)


def install_private_log(
    level: str = "warning",
    form: LogFormat = "text",
    *,
    session_id: str | None = None,
    handler: logging.Handler | None = None,
    room: str = "",
) -> None:
    """Send all log records and uncaught exceptions to standard error, redacted.

    Parameters
    ----------
    level
        Of our own loggers; others log warnings and worse.
    session_id
        Session of all lines, in a process that serves one session.
    handler
        Receives the lines; a blocking one on standard error by default.
    room
        Name of the room, in each line of JSON.
    """
    handler = handler or logging.StreamHandler()
    handler.setFormatter(formatter(form, session_id, room))
    chosen = logging.getLevelNamesMapping()[level.upper()]
    logging.basicConfig(level=max(chosen, logging.WARNING), handlers=[handler], force=True)
    for name in OURS:
        logging.getLogger(name).setLevel(chosen)
    sys.excepthook = _log_uncaught
    threading.excepthook = _log_thread


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)
        return
    logger.critical("Tidegate failed", exc_info=(kind, error, trace))


def _log_thread(found: threading.ExceptHookArgs) -> None:
    name = "?" if found.thread is None else found.thread.name
    if found.exc_value is not None and not isinstance(found.exc_value, SystemExit):
        logger.critical("the thread %s failed", name, exc_info=found.exc_value)
