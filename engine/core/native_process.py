"""What a process sets before its work: threads of native libraries, memory that stays, the end with its parent.

Native libraries have no threads of their own, so that no call of one thread waits for another's. OpenBLAS lets one
multi-threaded call in at a time. With its pool on, a small product in the engine thread waits for the trainer's large
one, for seconds on two busy cores. With one thread a call each runs where it was made.

Freed memory is kept by the process, so that the next frame finds it where the last one left it. A frame needs some
megabytes and drops them again. The C library gives these back to the system at once and asks for them anew thirty times
a second, and every page comes with a fault: much of the time that decoding a picture takes.

The kernel signals a process whose parent has ended, in case it does not notice that by itself. Linux sends it when the
thread ends that started the process.
"""

import ctypes
import multiprocessing
import os
import signal

from threadpoolctl import threadpool_limits

KEPT_BYTES = 1 << 26
"""Freed memory at the heap's end is given back only beyond this."""
OWN_PAGES_BYTES = 1 << 21
"""Smaller arrays than this, a frame's pictures among them, come from the heap; larger ones have pages of their own."""
# <malloc.h>
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_PR_SET_PDEATHSIG = 1


def keep_calls_in_their_thread() -> None:
    """Let BLAS, OpenMP and OpenCV use only the calling thread, in the whole process, from now on."""
    import cv2  # not of use to a process before it measures

    threadpool_limits(limits=1)
    cv2.setNumThreads(1)


def keep_freed_memory() -> None:
    """Let the C library keep what frames free, in the whole process, from now on (glibc only)."""
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_TRIM_THRESHOLD, KEPT_BYTES)
        set_option(_M_MMAP_THRESHOLD, OWN_PAGES_BYTES)


def share_one_heap() -> None:
    """Let all threads take memory from one heap, in the whole process, from now on (glibc only).

    Otherwise each of a service's twenty threads has its own, and what one frees the others cannot use: under load these
    grow by twenty megabytes an hour with nothing in them.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_ARENA_MAX, 1)


def give_freed_memory_back() -> None:
    """Let the C library return what lies free anywhere (glibc only); some 10 ms after a fit, so not on a frame's way.

    A fit frees a hundred megabytes in pieces, between pieces that stay: without this every retraining leaves more.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


# <sys/prctl.h>


def end_with_the_pool() -> None:
    """Kill this worker of a pool of processes when the process that made the pool ends, or has ended."""
    signal_at_parent_death(signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():
        os.kill(os.getpid(), signal.SIGKILL)


def signal_at_parent_death(number: signal.Signals) -> None:
    """Request a signal for the moment at which the parent ends; one that has ended already is not noticed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
