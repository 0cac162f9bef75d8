"""A saboteur inside the process it breaks: the product has no hook for this.

A thread listens on a Unix socket and does to its own process what a test asks: raises in a thread, holds the
interpreter, takes every file descriptor, blocks the event loop, hangs the engine at a frame. One line in, one line out:
``done NS``, in host monotonic time when it began, or ``failed WHY``.
"""

import asyncio
import ctypes
import gc
import os
import resource
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from engine.control.loop import EngineLoop
from service.sessions.lifecycle.writer import SessionWriter

HELD_PYTHON = ctypes.PyDLL(None)
"""Calls through this keep the interpreter for themselves."""


class Sabotaged(BaseException):
    """Raised in a thread out of nowhere."""


def kill_thread(name: str, function: str = "") -> int:
    """Raise in the newest living thread of that name that is in that function, at its next instruction."""
    named = [thread for thread in threading.enumerate() if thread.name == name]
    found = [thread.ident for thread in named if thread.ident is not None and _is_in(thread.ident, function)]
    if not found:
        msg = f"no thread {name} in {function}; there are {sorted(thread.name for thread in threading.enumerate())}"
        raise LookupError(msg)
    at_ns = time.monotonic_ns()
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(found[-1]), ctypes.py_object(Sabotaged))
    return at_ns


def _is_in(identity: int, function: str) -> bool:
    frame = sys._current_frames().get(identity)
    while frame is not None and function and frame.f_code.co_name != function:
        frame = frame.f_back
    return frame is not None


def hold_interpreter(ms: str) -> int:
    """Let no other Python thread run for so long."""
    at_ns = time.monotonic_ns()
    HELD_PYTHON.usleep(int(float(ms) * 1000))
    return at_ns


def take_files(ms: str) -> int:
    """Take every file descriptor there is, give them back later."""
    taken: list[int] = []
    at_ns = time.monotonic_ns()
    try:
        while True:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    except OSError:
        pass
    threading.Timer(float(ms) / 1000, lambda: [os.close(one) for one in taken]).start()
    return at_ns


def block_event_loop(ms: str) -> int:
    """Let uvicorn's event loop serve no one for so long."""
    loops = [one for one in gc.get_objects() if isinstance(one, asyncio.AbstractEventLoop) and one.is_running()]
    at_ns = time.monotonic_ns()
    for loop in loops:
        loop.call_soon_threadsafe(time.sleep, float(ms) / 1000)
    return at_ns


def hang_engine(ms: str) -> int:
    """Let the engine's thread hang where it measures its next frame."""
    return _before_measuring(lambda: time.sleep(float(ms) / 1000))


def fail_engine(text: str) -> int:
    """Let the measuring of the next frame raise."""

    def fail() -> None:
        raise ArithmeticError(text)

    return _before_measuring(fail)


def hang_writer(ms: str) -> int:
    """Let the thread that writes hang at its next turn, as a disk that never answers would let it."""
    writers = [one for one in gc.get_objects() if isinstance(one, SessionWriter) and one.is_alive()]
    if not writers:
        msg = "no writer runs"
        raise LookupError(msg)
    writer = writers[-1]
    look = writer._check_disk

    begun = threading.Event()
    began_ns: list[int] = []

    def hang() -> None:
        writer._check_disk = look
        began_ns.append(time.monotonic_ns())
        begun.set()
        time.sleep(float(ms) / 1000)

    writer._check_disk = hang
    if not begun.wait(5.0):
        msg = "the writer does not turn"
        raise TimeoutError(msg)
    return began_ns[0]


def fill_memory(mb: str, ms: str) -> int:
    """Let the process grow by no more than so many MB for so long."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + int(float(mb) * 2**20)
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    at_ns = time.monotonic_ns()
    threading.Timer(float(ms) / 1000, lambda: resource.setrlimit(resource.RLIMIT_AS, (hard, hard))).start()
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    return at_ns


ACTS: dict[str, Callable[..., int]] = {
    "kill": kill_thread,
    "hold": hold_interpreter,
    "files": take_files,
    "loop": block_event_loop,
    "hang": hang_engine,
    "fail": fail_engine,
    "memory": fill_memory,
    "writer": hang_writer,
}


def _before_measuring(act: Callable[[], None]) -> int:
    """Do something in the engine's thread at its next frame; return when that frame had come."""
    engines = [one for one in gc.get_objects() if isinstance(one, EngineLoop) and not one.status.is_over]
    if not engines:
        msg = "no engine runs"
        raise LookupError(msg)
    pipeline = engines[-1]._session._measurer
    measure = pipeline.measure
    begun = threading.Event()
    received: list[int] = []

    def spoiled(frame):
        pipeline.measure = measure
        received.append(frame.received_ns)
        begun.set()
        act()
        return measure(frame)

    pipeline.measure = spoiled
    if not begun.wait(5.0):
        msg = "no frame came"
        raise TimeoutError(msg)
    return received[0]


def listen(path: str) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path)
        server.listen()
        while True:
            connection, _ = server.accept()
            with connection, connection.makefile("rw") as lines:
                lines.write(_answer(lines.readline().split()) + "\n")
                lines.flush()


def _answer(words: list[str]) -> str:
    try:
        return f"done {ACTS[words[0]](*words[1:])}"
    except Exception as error:  # noqa: BLE001 - whatever it was is the asker's to hear
        return f"failed {type(error).__name__}: {error}"


def let_in(path: str) -> None:
    """Let a saboteur listen in this process."""
    threading.Thread(target=listen, args=(path,), name="saboteur", daemon=True).start()
