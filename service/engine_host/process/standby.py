"""The standby process: started and imported in advance, so that a session starts without delay.

One is started at the service's start and after each session, never beside one: its imports would take a processor core
from the frames being measured.
"""

import contextlib
import logging
import threading

from service.core.errors import EngineProcessError
from service.engine_host.process.channels import ChannelClosedError
from service.engine_host.process.child_process import ChildProcess, start_child
from service.engine_host.process.messages import Prepare, Ready

logger = logging.getLogger(__name__)

START_S = 30.0
LOOK_S = 0.5
AGAIN_S = 2.0
NONE_YET = "the engine process is being started"


class StandbyProcess:
    """Keeps one process on standby while one is wanted."""

    def __init__(self, prepare: Prepare) -> None:
        self._prepare = prepare
        self._change = threading.Condition()
        self._is_wanted, self._is_closed = True, False
        self._ready: ChildProcess | None = None
        self._starting: ChildProcess | None = None
        self._trouble: str | None = NONE_YET
        self.lost = 0
        self._thread = threading.Thread(target=self._run, name="tidegate-engine-standby", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """Why there is no standby process although one is wanted; None otherwise."""
        with self._change:
            return None if self._ready is not None or not self._is_wanted else self._trouble or NONE_YET

    def want(self) -> None:
        """Start one, and replace it when it dies, until one is taken."""
        with self._change:
            self._is_wanted = True
            self._change.notify_all()

    def take(self) -> ChildProcess:
        """Take the standby process, or wait for the next; none is started until one is wanted again.

        Raises
        ------
        EngineProcessError
            None is ready after 30 s, or the service is closing.
        """
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

    def give_back(self, child: ChildProcess) -> None:
        """Put a process back after a camera request; start another where it died."""
        with self._change:
            self._is_wanted = True
            if not child.is_alive:
                self.lost += 1
                self._change.notify_all()
                return
            is_kept = self._adopt(child)
        if not is_kept:
            _reap(child)

    def close(self) -> None:
        """End the standby process; the kernel ends one that is taken, when this object's thread ends."""
        with self._change:
            self._is_closed = True
            child, self._ready = self._ready, None
            if self._starting is not None:
                self._starting.kill()
            self._change.notify_all()
        if child is not None:
            child.reap()
            child.page.close()
        self._thread.join(START_S)

    def _run(self) -> None:
        while not self._is_closed:
            with self._change:
                self._change.wait_for(lambda: self._is_closed or self._is_due, LOOK_S)
                self._reap_dead()
                is_due = self._is_due and not self._is_closed
            if is_due and not self._start():
                with self._change:
                    self._change.wait_for(lambda: self._is_closed, AGAIN_S)

    @property
    def _is_due(self) -> bool:
        return self._is_wanted and self._ready is None

    def _reap_dead(self) -> None:
        """Reap a standby process that died."""
        if self._ready is not None and not self._ready.is_alive:
            child, self._ready = self._ready, None
            self.lost += 1
            logger.warning("the standby engine process died (status %s)", child.reap())

    def _start(self) -> bool:
        """Start one; return False where that failed."""
        try:
            child = self._starting = start_child()
        except OSError as error:
            self._trouble = f"the engine's process does not start: {error.strerror}"
            logger.error("%s", self._trouble)  # noqa: TRY400 - the text is complete
            return False
        try:
            child.bulk.set_timeout(START_S)
            child.bulk.send(self._prepare)
            assert isinstance(child.bulk.receive(), Ready)
            child.bulk.set_timeout(None)
        except ChannelClosedError:
            child.kill()
            status = child.reap()
            self._starting = None
            self._trouble = f"the engine's process ended before it was ready (status {status})"
            if not self._is_closed:
                logger.error("%s", self._trouble)  # noqa: TRY400 - the text is complete
            return False
        self._starting = None
        with self._change:
            is_kept = self._adopt(child)
        if not is_kept:
            _reap(child)
        return True

    def _adopt(self, child: ChildProcess) -> bool:
        """Keep it on standby unless there is one, or this is closed; called with the lock held."""
        is_kept = not self._is_closed and self._ready is None
        if is_kept:
            self._ready, self._trouble = child, None
        self._change.notify_all()
        return is_kept


def _reap(child: ChildProcess) -> None:
    with contextlib.suppress(OSError):
        child.reap()
