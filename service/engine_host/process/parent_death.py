"""The kernel's signal to an engine process whose service has ended, in case it does not read its channels.

Linux sends it when the thread ends that started the process: the one that keeps the standby process.
"""

import ctypes
import signal

_PR_SET_PDEATHSIG = 1
# <sys/prctl.h>


def end_with_the_service() -> None:
    """Request SIGKILL: no line is open yet, and a camera driver that hangs would keep the camera."""
    _at_the_end_of_the_service(signal.SIGKILL)


def wake_without_the_service() -> None:
    """Request SIGCONT: a stopped process continues, to hold its session's line and complete its journal before it ends.

    The kernel also continues orphaned process groups; whether it does depends on the group's parents.
    """
    _at_the_end_of_the_service(signal.SIGCONT)


def _at_the_end_of_the_service(number: signal.Signals) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
