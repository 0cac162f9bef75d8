"""Native libraries' own threads: none, so that no call of one thread waits for another's.

OpenBLAS lets one multi-threaded call in at a time. With its pool on, a small product in the engine thread waits for the
trainer's large one, for seconds on two busy cores. With one thread a call each runs where it was made.
"""

import cv2
from threadpoolctl import threadpool_limits


def keep_calls_in_their_thread() -> None:
    """Let BLAS, OpenMP and OpenCV use only the calling thread, in the whole process, from now on."""
    threadpool_limits(limits=1)
    cv2.setNumThreads(1)
