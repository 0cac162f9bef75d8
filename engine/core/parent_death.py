"""The kernel's signal to a process whose parent has ended, in case it does not notice that by itself.

Linux sends it when the thread ends that started the process.
"""

import ctypes
import signal

_PR_SET_PDEATHSIG = 1
# <sys/prctl.h>


def signal_at_parent_death(number: signal.Signals) -> None:
    """Request a signal for the moment at which the parent ends; one that has ended already is not noticed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
