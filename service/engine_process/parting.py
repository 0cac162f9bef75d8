"""What becomes of an engine's process that does not hear that the service is gone.

The kernel tells of it when the thread ends that started the process: the one that keeps one standing by.
"""

import ctypes
import signal

_PR_SET_PDEATHSIG = 1
# <sys/prctl.h>


def end_with_the_service() -> None:
    """End at once: no line is open yet, and a camera's driver that hangs would keep the camera."""
    _at_the_end_of_the_service(signal.SIGKILL)


def wake_without_the_service() -> None:
    """Go on, if this process was stopped: a session's line is to be held, and its journal written, before it ends.

    The kernel wakes what is left of a group without a parent, too; that depends on how the groups lie.
    """
    _at_the_end_of_the_service(signal.SIGCONT)


def _at_the_end_of_the_service(number: signal.Signals) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
