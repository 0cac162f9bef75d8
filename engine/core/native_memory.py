"""Freed memory kept by the process, so that the next frame finds it where the last one left it.

A frame needs some megabytes and drops them again. The C library gives these back to the system at once and asks for
them anew thirty times a second, and every page comes with a fault: much of the time that decoding a picture takes.
"""

import ctypes

KEPT_BYTES = 1 << 26
"""Freed memory at the heap's end is given back only beyond this."""
OWN_PAGES_BYTES = 1 << 21
"""Smaller arrays than this, a frame's pictures among them, come from the heap; larger ones have pages of their own."""

# <malloc.h>
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def keep_freed_memory() -> None:
    """Let the C library keep what frames free, in the whole process, from now on (glibc only)."""
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_TRIM_THRESHOLD, KEPT_BYTES)
        set_option(_M_MMAP_THRESHOLD, OWN_PAGES_BYTES)


def give_freed_memory_back() -> None:
    """Let the C library return what lies free anywhere (glibc only); some 10 ms after a fit, so not on a frame's way.

    A fit frees a hundred megabytes in pieces, between pieces that stay: without this every retraining leaves more.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
