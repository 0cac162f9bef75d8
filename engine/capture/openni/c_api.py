"""The calls of OniCAPI.h that Tidegate makes, as ctypes; only ``engine.capture.openni.source`` and the recorder see it.

Structures and numbers are those of OpenNI 2.2. Frames are memory of the runtime's: copy before releasing.

Threads that never end, for all calls of the OpenNI2 runtime.

The runtime keeps a record of each thread that ever called it (for its errors, and an event for those that waited), and
checks those threads with ``pthread_kill(thread, 0)`` whenever a new one calls. For a thread that has ended, this reads
memory that is in use elsewhere: the process crashes or hangs, both were observed. So no thread that calls the runtime
may end. A thread that hangs in a driver is not reused.
"""

import ctypes
import ctypes.util
import logging
import os
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from engine.core.errors import RuntimeMissingError

_log = logging.getLogger(__name__)
_lock = threading.Lock()
_idle: list["_LastingThread"] = []
_here = threading.local()
T = TypeVar("T")
APT_LINE = "apt-get install libopenni2-0"
API_VERSION = 2002
MAX_TEXT = 256
STATUS_OK, STATUS_TIME_OUT = 0, 102
SENSOR_COLOR, SENSOR_DEPTH = 2, 3
PIXEL_DEPTH_1_MM, PIXEL_DEPTH_100_UM, PIXEL_RGB888 = 100, 101, 200
STATE_EOF = 3
DEVICE_SERIAL_NUMBER = 3
DEVICE_IMAGE_REGISTRATION = 5
DEVICE_PLAYBACK_SPEED = 100
DEVICE_PLAYBACK_REPEAT = 101
STREAM_HORIZONTAL_FOV, STREAM_VERTICAL_FOV = 1, 2
STREAM_VIDEO_MODE = 3
STREAM_MIRRORING = 7
REGISTRATION_OFF, REGISTRATION_DEPTH_TO_COLOR = 0, 1
Handle = ctypes.c_void_p
_Int, _Out = ctypes.c_int, ctypes.POINTER
_initialising = threading.Lock()


def run_on_lasting_thread(work: Callable[[], None]) -> threading.Event:
    """Run ``work`` on an idle thread, or a new one; the event is set when it has returned."""
    done = threading.Event()
    with _lock:
        thread = _idle.pop() if _idle else _LastingThread()
    thread.jobs.put((work, done))
    return done


def call_on_lasting_thread(function: Callable[..., T], *arguments: object) -> T:
    """Call ``function`` and wait for it: directly on a lasting thread, else on an idle one."""
    if getattr(_here, "lasts", False):
        return function(*arguments)
    answer: Future[T] = Future()

    def work() -> None:
        try:
            answer.set_result(function(*arguments))
        except BaseException as error:  # noqa: BLE001 - raised again in the caller
            answer.set_exception(error)

    run_on_lasting_thread(work)
    return answer.result()


class _LastingThread:
    """One thread and its jobs; it runs until the process ends."""

    def __init__(self) -> None:
        self.jobs: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        threading.Thread(target=self._serve, name="openni-capture", daemon=True).start()

    def _serve(self) -> None:
        _here.lasts = True
        while True:
            work, done = self.jobs.get()
            try:
                work()
            except BaseException:  # noqa: BLE001
                # A bug, which is logged; ending this thread would let the next one crash the process.
                _log.exception("capture has failed")
            done.set()
            with _lock:
                _idle.append(self)


class VideoMode(ctypes.Structure):
    """OniVideoMode."""

    _fields_ = (
        ("pixel_format", ctypes.c_int),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
        ("fps", ctypes.c_int),
    )


class SensorInfo(ctypes.Structure):
    """OniSensorInfo."""

    _fields_ = (
        ("sensor_type", ctypes.c_int),
        ("mode_count", ctypes.c_int),
        ("modes", ctypes.POINTER(VideoMode)),
    )


class DeviceInfo(ctypes.Structure):
    """OniDeviceInfo."""

    _fields_ = (
        ("uri", ctypes.c_char * MAX_TEXT),
        ("vendor", ctypes.c_char * MAX_TEXT),
        ("name", ctypes.c_char * MAX_TEXT),
        ("usb_vendor", ctypes.c_uint16),
        ("usb_product", ctypes.c_uint16),
    )


class Frame(ctypes.Structure):
    """OniFrame."""

    _fields_ = (
        ("data_size", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("sensor_type", ctypes.c_int),
        ("timestamp_us", ctypes.c_uint64),
        ("frame_index", ctypes.c_int),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
        ("video_mode", VideoMode),
        ("is_cropped", ctypes.c_int),
        ("crop_x", ctypes.c_int),
        ("crop_y", ctypes.c_int),
        ("stride", ctypes.c_int),
    )


DeviceCallback = ctypes.CFUNCTYPE(None, ctypes.POINTER(DeviceInfo), ctypes.c_void_p)
StateCallback = ctypes.CFUNCTYPE(None, ctypes.POINTER(DeviceInfo), ctypes.c_int, ctypes.c_void_p)


class DeviceCallbacks(ctypes.Structure):
    """OniDeviceCallbacks; must live as long as it is registered."""

    _fields_ = (("connected", DeviceCallback), ("disconnected", DeviceCallback), ("state_changed", StateCallback))


_SIGNATURES: dict[str, tuple[object, Sequence[object]]] = {
    "oniInitialize": (_Int, (_Int,)),
    "oniGetExtendedError": (ctypes.c_char_p, ()),
    "oniGetDeviceList": (_Int, (_Out(_Out(DeviceInfo)), _Out(_Int))),
    "oniReleaseDeviceList": (_Int, (_Out(DeviceInfo),)),
    "oniRegisterDeviceCallbacks": (_Int, (_Out(DeviceCallbacks), ctypes.c_void_p, _Out(Handle))),
    "oniUnregisterDeviceCallbacks": (None, (Handle,)),
    "oniWaitForAnyStream": (_Int, (_Out(Handle), _Int, _Out(_Int), _Int)),
    "oniDeviceOpen": (_Int, (ctypes.c_char_p, _Out(Handle))),
    "oniDeviceClose": (_Int, (Handle,)),
    "oniDeviceGetInfo": (_Int, (Handle, _Out(DeviceInfo))),
    "oniDeviceGetSensorInfo": (_Out(SensorInfo), (Handle, _Int)),
    "oniDeviceCreateStream": (_Int, (Handle, _Int, _Out(Handle))),
    "oniDeviceSetProperty": (_Int, (Handle, _Int, ctypes.c_void_p, _Int)),
    "oniDeviceGetProperty": (_Int, (Handle, _Int, ctypes.c_void_p, _Out(_Int))),
    "oniDeviceIsPropertySupported": (_Int, (Handle, _Int)),
    "oniDeviceIsImageRegistrationModeSupported": (_Int, (Handle, _Int)),
    "oniStreamDestroy": (None, (Handle,)),
    "oniStreamStart": (_Int, (Handle,)),
    "oniStreamStop": (None, (Handle,)),
    "oniStreamReadFrame": (_Int, (Handle, _Out(_Out(Frame)))),
    "oniStreamSetProperty": (_Int, (Handle, _Int, ctypes.c_void_p, _Int)),
    "oniStreamGetProperty": (_Int, (Handle, _Int, ctypes.c_void_p, _Out(_Int))),
    "oniStreamIsPropertySupported": (_Int, (Handle, _Int)),
    "oniFrameRelease": (None, (_Out(Frame),)),
    "oniCreateRecorder": (_Int, (ctypes.c_char_p, _Out(Handle))),
    "oniRecorderAttachStream": (_Int, (Handle, Handle, _Int)),
    "oniRecorderStart": (_Int, (Handle,)),
    "oniRecorderStop": (None, (Handle,)),
    "oniRecorderDestroy": (_Int, (_Out(Handle),)),
    "oniSetLogConsoleOutput": (_Int, (_Int,)),
}


def library_path() -> str | None:
    """Find the runtime: the folder named by ``OPENNI2_REDIST`` first, then the system's libraries."""
    folder = os.environ.get("OPENNI2_REDIST")
    if folder:
        for name in ("libOpenNI2.so", "libOpenNI2.so.0"):
            if (Path(folder) / name).is_file():
                return str(Path(folder) / name)
    return ctypes.util.find_library("OpenNI2")


class Runtime:
    """The library's calls by their own names, each made on a thread that never ends.

    The library keeps the text of a failure per thread, so it is read in the thread that failed.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._failure = threading.local()

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return one of the calls in ``_SIGNATURES``."""
        if name not in _SIGNATURES:
            raise AttributeError(name)
        result, arguments = _SIGNATURES[name]
        function = getattr(self._library, name)
        function.restype, function.argtypes = result, arguments

        def call(*given: object) -> object:
            answer, words = call_on_lasting_thread(self._call, function, given)
            if words is not None:
                self._failure.words = words
            return answer

        self.__dict__[name] = call
        return call

    def _call(self, function: Callable[..., object], given: tuple[object, ...]) -> tuple[object, str | None]:
        answer = function(*given)
        has_failed = isinstance(answer, int) and answer != STATUS_OK
        return answer, self._words() if has_failed else None

    def _words(self) -> str:
        text: bytes = self._library.oniGetExtendedError() or b""
        return " ".join(text.decode(errors="replace").split()) or "no reason given"

    def last_error(self) -> str:
        """Return what the library said of this thread's last failure, in one line."""
        return str(getattr(self._failure, "words", "no reason given"))


@cache
def _load() -> Runtime:
    path = library_path()
    if path is None:
        msg = f"the OpenNI2 runtime is not installed: {APT_LINE}"
        raise RuntimeMissingError(msg)
    try:
        library = ctypes.CDLL(path)
        library.oniGetExtendedError.restype = ctypes.c_char_p
        runtime = Runtime(library)
        for name in _SIGNATURES:
            getattr(runtime, name)
    except (OSError, AttributeError) as error:
        msg = f"the OpenNI2 runtime {path} cannot be loaded ({error}): {APT_LINE}"
        raise RuntimeMissingError(msg) from error
    if runtime.oniInitialize(API_VERSION) != STATUS_OK:
        msg = f"the OpenNI2 runtime {path} does not start: {runtime.last_error()}"
        raise RuntimeMissingError(msg)
    return runtime


def runtime() -> Runtime:
    """Return the runtime, loaded and initialised once a process and never shut down.

    Shutting down is what hangs and crashes in its drivers; the process's end does it.

    Raises
    ------
    RuntimeMissingError
        Not on this machine, or not usable; the message names the package to install.
    """
    with _initialising:
        return _load()


def last_error() -> str:
    """Return what the runtime said of this thread's last failure, in one line."""
    return runtime().last_error()
