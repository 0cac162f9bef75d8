"""How warm the room's cameras are, from session to session, and a camera that goes on running between two of them.

A session's engine has a process of its own, so the warmth is in a file, written every few seconds while the camera
delivers. What cannot be read there counts as cold: that only lengthens the time until the beam may be on.
"""

import fcntl
import json
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from engine.capture import DepthSource, LiveSource, SourceDescription, drivers
from engine.core.clock import Clock
from engine.core.errors import FrameTimeoutError, TidegateError
from engine.core.files import write_whole
from engine.core.frames import RgbdFrame
from engine.core.warmth import Warmth
from service.core.settings.settings import Settings

logger = logging.getLogger(__name__)

NAME = "camera-warmth.json"
SAVE_S = 10.0
KEEP_FROM_S, RETRY_S = 3.0, 30.0
"""How long after the start of a process on standby a camera is taken, and after a failure again [s]."""
READ_S, END_S = 1.0, 22.0
"""Longest read; and how long a camera that is being opened may take until it is released again [s]."""
S_PER_MIN = 60.0
FRAMES_BETWEEN_LOOKS = 15
WANTED, KEPT = "camera.wanted", "camera.kept"
CLAIM_POLL_S = 0.05


class RunTime(NamedTuple):
    """Time since the machine's start, which no setting of its clock moves; ``boot`` names that start."""

    boot: str
    seconds: float


def machine_run_time() -> RunTime:
    """Return the run time of this machine, its sleep included."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        boot = ""
    return RunTime(boot, time.clock_gettime(time.CLOCK_BOOTTIME))


class Seen(NamedTuple):
    """What the file says of a camera: its warmth, since when, when a session used it last [s], and its address."""

    cold_share: float
    boot: str
    at_s: float
    used_s: float
    address: str


class WarmthFile:
    """The file, with a line for each camera by its serial number: another one at the same socket is another one.

    A camera without a serial number, and one of before the machine's start, is cold.
    """

    def __init__(self, folder: Path, run_time: Callable[[], RunTime] = machine_run_time) -> None:
        self._path, self._run_time = folder / NAME, run_time

    def read(self, serial: str, warm_up_s: float) -> Warmth:
        """Return the warmth of a camera that has not run since it was written down; cold where that is not known."""
        now, seen = self._run_time(), self._all().get(serial)
        if seen is None or not now.boot or seen.boot != now.boot or seen.at_s > now.seconds:
            return Warmth(warm_up_s)
        warmth = Warmth(warm_up_s, seen.cold_share)
        warmth.rest(now.seconds - seen.at_s)
        return warmth

    def write(self, serial: str, warmth: Warmth, *, address: str, is_used: bool) -> None:
        """Write down a camera that runs now, ``is_used`` by a session; a full disk leaves the file as it was."""
        now = self._run_time()
        if not serial or not now.boot:
            return
        cameras = {name: one for name, one in self._all().items() if one.boot == now.boot}
        before = cameras.get(serial)
        used_s = now.seconds if is_used or before is None else before.used_s
        cameras[serial] = Seen(warmth.cold_share, now.boot, now.seconds, used_s, address)
        text = {name: list(one) for name, one in cameras.items()}
        with suppress(OSError):
            write_whole(self._path, json.dumps(text, indent=1).encode())

    def newest(self) -> tuple[str, float] | None:
        """Return the address of the camera that a session used last, and how long ago [s]; None without one."""
        now = self._run_time()
        cameras = [one for one in self._all().values() if one.boot == now.boot]
        if not cameras:
            return None
        newest = max(cameras, key=lambda one: one.used_s)
        return newest.address, now.seconds - newest.used_s

    def _all(self) -> dict[str, Seen]:
        try:
            given = json.loads(self._path.read_text())
            return {str(name): _seen(*one) for name, one in given.items()}
        except (OSError, ValueError, TypeError, AttributeError):
            return {}


def _seen(cold_share: float, boot: str, at_s: float, used_s: float, address: str) -> Seen:
    if not 0.0 <= cold_share <= 1.0 or not all(map(math.isfinite, (at_s, used_s))):
        raise ValueError(cold_share)
    return Seen(float(cold_share), str(boot), float(at_s), float(used_s), str(address))


class WarmingSource:
    """A source whose frames warm its camera: it writes that down every `SAVE_S`, in a thread of its own."""

    def __init__(
        self, source: DepthSource, warmth: Warmth, file: WarmthFile, address: str, *, is_used: bool = True
    ) -> None:
        self._source, self._warmth = source, warmth
        self._file, self._address, self._is_used = file, address, is_used
        self._serial = ""
        self._stop = threading.Event()
        self._saver: threading.Thread | None = None

    def open(self) -> SourceDescription:
        """Open the source; only now it is known which camera that is, and how cold."""
        described = self._source.open()
        self._serial = described.serial
        self._warmth.cold_share = self._file.read(self._serial, self._warmth.warm_up_s).cold_share
        self._stop = threading.Event()
        self._saver = threading.Thread(target=self._run, name="camera-warmth", daemon=True)
        self._saver.start()
        return replace(described, cold_share=self._warmth.cold_share)

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame."""
        frame = self._source.read(timeout_s)
        self._warmth.frame(frame.received_ns)
        return frame

    def close(self) -> None:
        """Close the source."""
        self._stop.set()
        self._source.close()
        if self._saver is not None:
            self._saver.join(READ_S)

    def _run(self) -> None:
        is_over = False
        while not is_over:
            is_over = self._stop.wait(SAVE_S)
            self._file.write(self._serial, self._warmth, address=self._address, is_used=self._is_used)


class CameraClaim:
    """Who has the room's camera: what needs it claims it, and the keeper, in another process, lets go.

    The claim is an advisory lock of the operating system on one file, the keeper's hold one on another; both go when
    their process ends, however that ends.
    """

    def __init__(self, folder: Path) -> None:
        self._wanted, self._kept = folder / WANTED, folder / KEPT

    @property
    def is_wanted(self) -> bool:
        """Whether something needs the camera."""
        with _locked(self._wanted) as is_free:
            return not is_free

    @contextmanager
    def kept(self) -> Iterator[bool]:
        """Hold the camera as its keeper; yields whether it may be kept."""
        with _locked(self._kept) as is_free:
            yield is_free and not self.is_wanted

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Need the camera: yields once its keeper has let go, or has not within `END_S`."""
        with _locked(self._wanted):
            deadline_s = time.monotonic() + END_S
            while time.monotonic() < deadline_s:
                with _locked(self._kept) as is_free:
                    if is_free:
                        break
                time.sleep(CLAIM_POLL_S)
            yield


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Yield whether the lock on a file could be had; a folder that cannot be written locks nothing."""
    try:
        held = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:
        yield True
        return
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True
    finally:
        os.close(held)


class ClaimingSource:
    """A source of the room's camera that is claimed for as long as it is open."""

    def __init__(self, source: DepthSource, claim: CameraClaim) -> None:
        self._source, self._claim = source, claim
        self._held = ExitStack()

    def open(self) -> SourceDescription:
        """Claim the camera and open it."""
        self.close()
        self._held.enter_context(self._claim.claimed())
        try:
            return self._source.open()
        except BaseException:
            self._held.close()
            raise

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame."""
        return self._source.read(timeout_s)

    def close(self) -> None:
        """Close the source, and let the camera be kept again."""
        self._source.close()
        self._held.close()


class CameraKeeper:
    """Keeps the camera of the last session running while its process is on standby; what it sees is dropped.

    Used as a context, it releases the camera for what happens inside, and takes it again afterwards.
    """

    def __init__(self, settings: Settings, file: WarmthFile, clock: Clock) -> None:
        self._settings, self._file, self._clock = settings, file, clock
        self._claim = CameraClaim(settings.data_dir)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._has_ended = False

    def start(self) -> None:
        """Begin, where the site wants it."""
        if self._settings.keep_warm_min > 0.0 and not self._has_ended:
            self._stop = threading.Event()
            self._thread = threading.Thread(target=self._run, args=(self._stop,), name="camera-keeper", daemon=True)
            self._thread.start()

    def end(self) -> None:
        """Release the camera for good."""
        self._has_ended = True
        self._release()

    def __enter__(self) -> Self:
        """Release the camera."""
        self._release()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take it again."""
        self.start()

    def _release(self) -> None:
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(END_S)

    def _run(self, stop: threading.Event) -> None:
        wait_s = KEEP_FROM_S
        while not stop.wait(wait_s):
            wait_s = RETRY_S
            address = self._address()
            if address is None:
                continue
            try:
                with self._claim.kept() as may_keep:
                    if may_keep:
                        self._keep(address, stop)
            except TidegateError as error:
                logger.info("the camera does not run between sessions: %s", error)

    def _address(self) -> str | None:
        """Return the camera that is to be kept, None for none."""
        newest = self._file.newest()
        if newest is None or not 0.0 <= newest[1] <= S_PER_MIN * self._settings.keep_warm_min:
            return None
        address = newest[0]
        is_ours = address.startswith(self._settings.camera_uri)
        return address if is_ours and warm_up_s(address, self._settings) > 0.0 else None

    def _keep(self, address: str, stop: threading.Event) -> None:
        listed, options = drivers.listed_address(address), self._settings.camera_options
        camera: LiveSource = drivers.open_camera(listed, clock=self._clock, options=options)
        warmth = Warmth(warm_up_s(address, self._settings))
        source = WarmingSource(camera, warmth, self._file, address, is_used=False)
        try:
            source.open()
            while not stop.is_set() and self._address() == address and not self._claim.is_wanted:
                for _ in range(FRAMES_BETWEEN_LOOKS):
                    if stop.is_set():
                        break
                    with suppress(FrameTimeoutError):
                        source.read(READ_S)
        finally:
            source.close()


def warm_up_s(address: str | None, settings: Settings) -> float:
    """Return how long a cold camera runs before the beam may be on [s]: the site's value, or its kind's."""
    given_min = settings.warm_up_min
    return drivers.warm_up_s(address) if given_min is None else S_PER_MIN * given_min
