"""The service's log: what failed and where, never what it was about.

An exception's message may hold whatever was being worked on: a patient's reference, a row's values, a password. So
the log tells an exception by its kind and its place in the code, and leaves its message out; those that are ours are
told by whoever catches them, in words of their own.

Whatever is logged stands on lines of its own making: control characters in it are written as escapes, so that nobody
who can choose a name or a path can write lines into the log, or colours onto a terminal.
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

from service.core.logging.request_ids import current_request_id, current_session_id
from service.core.settings.monitoring import LogFormat

logger = logging.getLogger(__name__)
LINE = "%(asctime)s %(levelname)s %(name)s %(message)s"
OURS = ("service", "engine")
"""Loggers that a site's level is for; what libraries say below a warning is about their own insides, and URLs."""
TELLS_MORE = ("asyncio",)
"""Loggers that put an exception into their message's further lines."""
LONGEST_CHAIN = 8
HEAD = "Traceback (most recent call last):\n"
FIELDS = "fields"
"""The attribute of a record with what else its JSON line says: ``extra={FIELDS: {...}}``."""
LONGEST_MESSAGE = 4000
UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def in_one_line(text: str) -> str:
    """Write control characters, and those that turn the direction of writing, as escapes; cut what is too long."""
    cut = text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]}…"
    return UNSAFE.sub(lambda found: ascii(found.group())[1:-1], cut)


class RedactingFormatter(logging.Formatter):
    """Writes records down without the messages of exceptions, for a person."""

    def format(self, record: logging.LogRecord) -> str:
        """Write one record; a trace that another formatter has written into it is not taken over."""
        record.exc_text = None
        text = super().format(record)
        record.exc_text = None
        return text

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the base's name
        """Write the line without its trace: one line whatever was put into it."""
        record.message = _message_of(record)
        line = super().formatMessage(record)
        request_id = current_request_id()
        return line if request_id is None else f"{line} [{request_id}]"

    def formatException(  # noqa: N802 - the base's name
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None],
    ) -> str:
        """Write an exception's kinds and places."""
        return "" if ei[1] is None else trace_of(ei[1])


class JsonFormatter(logging.Formatter):
    """Writes records down as one JSON object a line, for a collector; of exceptions, too, kinds and places alone."""

    def __init__(self, session_id: str | None = None) -> None:
        super().__init__()
        self._session_id = session_id

    def format(self, record: logging.LogRecord) -> str:
        """Write one record."""
        fields = getattr(record, FIELDS, None)
        said: dict[str, object] = {
            "ts": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _message_of(record),
            "request_id": current_request_id(),
            "session_id": current_session_id() or self._session_id,
            **(fields if isinstance(fields, Mapping) else {}),
        }
        if record.exc_info and record.exc_info[1] is not None:
            said["exception"] = [_kind(one) for one in _chain(record.exc_info[1])]
            said["trace"] = trace_of(record.exc_info[1])
        return json.dumps({name: value for name, value in said.items() if value is not None}, allow_nan=False)


def _message_of(record: logging.LogRecord) -> str:
    text = record.getMessage()
    if record.name.partition(".")[0] in TELLS_MORE:
        text = text.partition("\n")[0]
    return in_one_line(text.rstrip("\n"))


def trace_of(error: BaseException) -> str:
    """Write where an exception came from, and of which kind it and those behind it are."""
    parts = []
    for found in _chain(error):
        frames = "".join(traceback.format_tb(found.__traceback__))
        parts.append(f"{HEAD}{frames}{_kind(found)} (its message is not told)")
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


def formatter(form: LogFormat, session_id: str | None = None) -> logging.Formatter:
    """Return what writes records in this form."""
    return JsonFormatter(session_id) if form == "json" else RedactingFormatter(LINE)


def install_private_log(
    level: str = "warning",
    form: LogFormat = "text",
    *,
    session_id: str | None = None,
    handler: logging.Handler | None = None,
) -> None:
    """Let all that is logged, and all that nobody catches, go to standard error like that.

    Parameters
    ----------
    level
        Of our own loggers; all others tell warnings and worse.
    session_id
        Whom all lines of this process belong to, in a process that is there for one session.
    handler
        What takes the lines; standard error, waited for, when left out.
    """
    handler = handler or logging.StreamHandler()
    handler.setFormatter(formatter(form, session_id))
    chosen = logging.getLevelNamesMapping()[level.upper()]
    logging.basicConfig(level=max(chosen, logging.WARNING), handlers=[handler], force=True)
    for name in OURS:
        logging.getLogger(name).setLevel(chosen)
    sys.excepthook = _tell_uncaught
    threading.excepthook = _tell_thread


def _tell_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)
        return
    logger.critical("Tidegate failed", exc_info=(kind, error, trace))


def _tell_thread(found: threading.ExceptHookArgs) -> None:
    name = "?" if found.thread is None else found.thread.name
    if found.exc_value is not None and not isinstance(found.exc_value, SystemExit):
        logger.critical("the thread %s failed", name, exc_info=found.exc_value)
