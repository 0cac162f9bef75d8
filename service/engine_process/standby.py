"""A process stands by, everything imported, so that a session begins at once: one at the start, one after each session.

Not beside a session: its imports would take a core from frames that are measured.
"""

import contextlib
import logging
import threading

from service.engine_process.child import Child, start_child
from service.engine_process.crossing import CrossingClosedError
from service.engine_process.messages import Prepare, Ready
from service.errors import EngineProcessError

logger = logging.getLogger(__name__)

START_S = 30.0
LOOK_S = 0.5
AGAIN_S = 2.0
NONE_YET = "the engine's process is being started"


class StandBy:
    """Keeps one process standing by while it is wanted."""

    def __init__(self, prepare: Prepare) -> None:
        self._prepare = prepare
        self._change = threading.Condition()
        self._is_wanted, self._is_closed = True, False
        self._ready: Child | None = None
        self._starting: Child | None = None
        self._trouble: str | None = NONE_YET
        self.lost = 0
        self._thread = threading.Thread(target=self._keep, name="tidegate-engine-standby", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """Why none stands by, though one should."""
        with self._change:
            return None if self._ready is not None or not self._is_wanted else self._trouble or NONE_YET

    def want(self) -> None:
        """Have one stand by from now on."""
        with self._change:
            self._is_wanted = True
            self._change.notify_all()

    def take(self) -> Child:
        """Take the one that stands by, or the next; none is started before one is wanted again."""
        with self._change:
            self._is_wanted = True
            self._change.notify_all()
            found = self._change.wait_for(lambda: self._ready is not None or self._is_closed, START_S)
            child, self._ready = self._ready, None
            if not found or child is None:
                msg = f"no session can begin: {self._trouble or NONE_YET}"
                raise EngineProcessError(msg)
            self._is_wanted = False
        return child

    def give_back(self, child: Child) -> None:
        """Have one that was only asked something stand by again; or another, where it did not live through that."""
        with self._change:
            self._is_wanted = True
            if not child.is_alive:
                self.lost += 1
                self._change.notify_all()
                return
            is_kept = self._keeps(child)
        if not is_kept:
            _bury(child)

    def close(self) -> None:
        """End the one that stands by; one that is just being asked something the kernel ends, with the thread here."""
        with self._change:
            self._is_closed = True
            child, self._ready = self._ready, None
            if self._starting is not None:
                self._starting.kill()
            self._change.notify_all()
        if child is not None:
            child.bury()
            child.page.close()
        self._thread.join(START_S)

    def _keep(self) -> None:
        while not self._is_closed:
            with self._change:
                self._change.wait_for(lambda: self._is_closed or self._is_due, LOOK_S)
                self._look_after()
                is_due = self._is_due and not self._is_closed
            if is_due and not self._start():
                with self._change:
                    self._change.wait_for(lambda: self._is_closed, AGAIN_S)

    @property
    def _is_due(self) -> bool:
        return self._is_wanted and self._ready is None

    def _look_after(self) -> None:
        """Bury one that died while it stood by."""
        if self._ready is not None and not self._ready.is_alive:
            child, self._ready = self._ready, None
            self.lost += 1
            logger.warning("the engine's process that stood by ended by itself (status %s)", child.bury())

    def _start(self) -> bool:
        """Start one; false where that did not work."""
        try:
            child = self._starting = start_child()
        except OSError as error:
            self._trouble = f"the engine's process does not start: {error.strerror}"
            logger.error("%s", self._trouble)  # noqa: TRY400 - the sentence says it
            return False
        try:
            child.speech.patience(START_S)
            child.speech.send(self._prepare)
            assert isinstance(child.speech.receive(), Ready)
            child.speech.patience(None)
        except CrossingClosedError:
            child.kill()
            status = child.bury()
            self._starting = None
            self._trouble = f"the engine's process ended before it was ready (status {status})"
            if not self._is_closed:
                logger.error("%s", self._trouble)  # noqa: TRY400 - the sentence says it
            return False
        self._starting = None
        with self._change:
            is_kept = self._keeps(child)
        if not is_kept:
            _bury(child)
        return True

    def _keeps(self, child: Child) -> bool:
        """Let it stand by, unless one does, or none is to any more; for whoever has the lock."""
        is_kept = not self._is_closed and self._ready is None
        if is_kept:
            self._ready, self._trouble = child, None
        self._change.notify_all()
        return is_kept


def _bury(child: Child) -> None:
    with contextlib.suppress(OSError):
        child.bury()
