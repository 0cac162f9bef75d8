"""A pytest plugin (``-p tests.support.guard_pages``): every array that a compiled function is given ends at a page that
cannot be read or written. A function that reads or writes one item beyond an array ends the process, which it does
otherwise only where the array happens to end at the end of the heap.
"""

import ctypes
import mmap
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from engine.core import compiled

PAGE = mmap.PAGESIZE
LIBC = ctypes.CDLL(None, use_errno=True)
MOST_KEPT = 2_000
NO_ARRAYS = "replaced"


class Guarded:
    """The compiled functions, each called with copies of its arrays; results are copied back."""

    def __init__(self, functions: Any) -> None:
        self._functions = functions
        self._kept: deque[mmap.mmap] = deque(maxlen=MOST_KEPT)

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._functions, name)
        return function if name == NO_ARRAYS or not callable(function) else self._called(function)

    def _called(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            passed = [self._passed(one) for one in given]
            answer = function(*passed)
            for one, copy in zip(given, passed, strict=True):
                if _is_copied(one) and one.flags.writeable:
                    one[...] = copy
            return answer

        return call

    def _passed(self, given: Any) -> Any:
        if isinstance(given, list):  # of arrays that are only read
            return [self._passed(one) for one in given]
        return self._guarded(given) if _is_copied(given) else given

    def _guarded(self, array: Any) -> Any:
        pages = -(-array.nbytes // PAGE)
        memory = mmap.mmap(-1, (pages + 1) * PAGE)
        begin = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        forbidden = LIBC.mprotect(ctypes.c_void_p(begin + pages * PAGE), ctypes.c_size_t(PAGE), 0)
        assert forbidden == 0, "the page behind the array stays readable"
        self._kept.append(memory)
        copy = np.frombuffer(memory, dtype=array.dtype, count=array.size, offset=pages * PAGE - array.nbytes)
        copy = copy.reshape(array.shape)
        copy[...] = array
        return copy


def _is_copied(one: object) -> bool:
    return isinstance(one, np.ndarray) and one.flags.c_contiguous and one.size > 0


if compiled.FramePath.kernels is not None:
    compiled.FramePath.kernels = Guarded(compiled.FramePath.kernels)
