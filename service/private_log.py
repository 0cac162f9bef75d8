"""The service's log: what failed and where, never what it was about.

An exception's message may hold whatever was being worked on: a patient's reference, a row's values, a password. So
the log tells an exception by its kind and its place in the code, and leaves its message out; those that are ours are
told by whoever catches them, in words of their own.
"""

import logging
import sys
import threading
import traceback
from types import TracebackType

logger = logging.getLogger(__name__)
LINE = "%(asctime)s %(levelname)s %(name)s %(message)s"
TELLS_MORE = ("asyncio",)
"""Loggers that put an exception into their message's further lines."""
LONGEST_CHAIN = 8
HEAD = "Traceback (most recent call last):\n"


class PrivateFormatter(logging.Formatter):
    """Writes records down without the messages of exceptions."""

    def format(self, record: logging.LogRecord) -> str:
        """Write one record; a trace that another formatter has written into it is not taken over."""
        record.exc_text = None
        if record.name.partition(".")[0] in TELLS_MORE:
            record.msg, record.args = record.getMessage().partition("\n")[0], None
        text = super().format(record)
        record.exc_text = None
        return text

    def formatException(  # noqa: N802 - the base's name
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None],
    ) -> str:
        """Write an exception's kinds and places."""
        return "" if ei[1] is None else trace_of(ei[1])


def trace_of(error: BaseException) -> str:
    """Write where an exception came from, and of which kind it and those behind it are."""
    parts: list[str] = []
    found: BaseException | None = error
    while found is not None and len(parts) < LONGEST_CHAIN:
        frames = "".join(traceback.format_tb(found.__traceback__))
        parts.append(f"{HEAD}{frames}{type(found).__module__}.{type(found).__qualname__} (its message is not told)")
        found = found.__cause__ or (None if found.__suppress_context__ else found.__context__)
    return "\n\nfrom\n\n".join(parts)


def install_private_log(level: int = logging.WARNING) -> None:
    """Let all that is logged, and all that nobody catches, go to standard error like that."""
    handler = logging.StreamHandler()
    handler.setFormatter(PrivateFormatter(LINE))
    logging.basicConfig(level=level, handlers=[handler], force=True)
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
