"""The engine's side of a camera's process: a live source whose driver is killed where it hangs."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from dataclasses import asdict
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from engine.capture.camera_process.server import (
    FRAME,
    FRAME_MARK,
    MAX_MESSAGE,
    SLOTS,
    TEXT_MARK,
    UNKNOWN_NS,
    Ring,
    ring_bytes,
)
from engine.capture.oni.reader import missed_between
from engine.capture.source import AS_IT_IS, CameraOptions, FactoryCalibration, ListedCamera, SourceDescription
from engine.core.clock import Clock
from engine.core.errors import FrameTimeoutError, RuntimeMissingError, SourceEndedError, SourceLostError
from engine.core.frames import ColorImage, RgbdFrame, frozen
from engine.core.geometry import Intrinsics, RigidTransform

MODULE = "engine.capture.camera_process"
CODE = Path(__file__).parents[3]
OPEN_S = 20.0
"""An SDK finds its devices, starts two streams and waits for the first frames: a few seconds."""
LIST_S = 10.0
CLOSE_S = 3.0
LOOK_AGAIN_S, BLIND_LOOK_AGAIN_S = 60.0, 10.0
"""An SDK is asked again after this time, or when a device was plugged in or out, where the bus can be read: each asking
is a process, of a second of the processor."""
SETTLED_S = 5.0
"""An SDK may see a device so long after the bus has it: until then each asking is a new one."""
USB = Path("/sys/bus/usb/devices")
LATEST_US = 2**53
US_PER_S = 1e6


def listed(module: str, label: str) -> list[ListedCamera]:
    """List the cameras of an SDK, as it last answered while no device came or went.

    Raises
    ------
    RuntimeMissingError
        The SDK does not start or answer.
    """
    last = _LISTED.get(module)
    present = Look.after(None if last is None else last[0])
    if last is None or not present.is_as(last[0]):
        last = _LISTED[module] = present, _asked(module, label, "list")["answer"]
    return [ListedCamera(**one) for one in last[1]]


class Look(NamedTuple):
    """One look at the USB bus: its time [s, host monotonic], and the devices with their numbers, new at each plugging.

    ``changed_s`` is when other devices were seen last.
    """

    at_s: float
    devices: frozenset[tuple[str, str]]
    changed_s: float

    @staticmethod
    def after(before: "Look | None") -> "Look":
        """Look at the bus; where there is none to be read, no device is on it."""
        found = set()
        with contextlib.suppress(OSError):
            for number in USB.glob("*/devnum"):
                with contextlib.suppress(OSError):
                    found.add((number.parent.name, number.read_text()))
        at_s, devices = time.monotonic(), frozenset(found)
        is_same = before is not None and before.devices == devices
        return Look(at_s, devices, before.changed_s if before is not None and is_same else at_s)

    def is_as(self, before: "Look") -> bool:
        """Whether an answer of before is as good as one of now."""
        longest_s = LOOK_AGAIN_S if self.devices else BLIND_LOOK_AGAIN_S
        return before.at_s - self.changed_s >= SETTLED_S and self.at_s - before.at_s < longest_s


_LISTED: dict[str, tuple[Look, list[dict[str, Any]]]] = {}
"""The last answer of each SDK's module."""


def factory_calibration(module: str, serial: str, label: str) -> FactoryCalibration:
    """Return a camera's own calibration.

    Raises
    ------
    RuntimeMissingError
        The SDK does not start, or does not answer.
    SourceLostError
        No such camera.
    """
    answer = _asked(module, label, "calibration", serial)
    if "refused" in answer:
        raise SourceLostError(str(answer["refused"]))
    found = answer["answer"]
    return FactoryCalibration(
        camera=found["camera"],
        serial=found["serial"],
        depth=Intrinsics(**{**found["depth"], "distortion": tuple(found["depth"]["distortion"])}),
        color=Intrinsics(**{**found["color"], "distortion": tuple(found["color"]["distortion"])}),
        color_from_depth=RigidTransform(
            rotation=np.array(found["rotation"]), translation_mm=np.array(found["translation_mm"])
        ),
    )


def _asked(module: str, label: str, *words: str) -> dict[str, Any]:
    """Ask an SDK something in a process of its own."""
    try:
        done = subprocess.run(  # noqa: S603 - this very program
            [*_command(module), *words], env=_environment(), capture_output=True, timeout=LIST_S, check=True
        )
        return dict(json.loads(done.stdout.splitlines()[-1]))
    except subprocess.TimeoutExpired as error:
        raise RuntimeMissingError(f"{label} does not answer within {LIST_S:g} s") from error
    except subprocess.CalledProcessError as error:
        last = error.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise RuntimeMissingError(f"{label} does not start: {''.join(last)[:300]}") from error
    except (OSError, ValueError, IndexError) as error:
        raise RuntimeMissingError(f"{label} does not start: {error}") from error


class ProcessSource:
    """A camera of an SDK in a process of its own; see :class:`engine.capture.source.LiveSource`.

    Parameters
    ----------
    module
        The module that imports the SDK; see :mod:`engine.capture.camera_process.native`.
    serial
        The camera's serial number.
    clock
        The clock of the frames' time stamps; the process stamps them with the same clock of the host.
    options
        How the camera is set.
    """

    def __init__(self, module: str, serial: str, *, clock: Clock, options: CameraOptions = AS_IT_IS) -> None:
        self._module, self._serial, self._clock = module, serial, clock
        self._options = json.dumps(asdict(options))
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._ring: Ring | None = None
        self._taken = self._index = 0
        self._last: tuple[int, int] | None = None
        self._color: tuple[int, ColorImage] | None = None
        self._period_us = US_PER_S / 30.0

    @property
    def is_free(self) -> bool:
        """Whether no call hangs any more: a process that was closed is gone."""
        return self._process is None

    @property
    def temperature_c(self) -> float | None:
        """The camera's temperature [degrees C]; None where it does not tell one, or is not open."""
        return None if self._ring is None else self._ring.temperature_c

    @property
    def process_id(self) -> int:
        """The id of the camera's process, while it is open."""
        assert self._process is not None
        return self._process.pid

    def open(self) -> SourceDescription:
        """Start the process and its camera.

        Raises
        ------
        SourceLostError
            The camera, or the recording, cannot be opened; the message has the SDK's reason.
        """
        self.close()
        ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel = ours
        try:
            self._process = subprocess.Popen(  # noqa: S603 - this very program
                [*_command(self._module), "stream", str(its.fileno()), self._serial, self._options],
                pass_fds=(its.fileno(),),
                stdin=subprocess.DEVNULL,
                env=_environment(),
            )
        except OSError as error:
            self.close()
            raise SourceLostError(f"the camera's process does not start: {error.strerror}") from error
        finally:
            its.close()
        try:
            return self._started(ours)
        except BaseException:
            self.close()
            raise

    def _started(self, channel: socket.socket) -> SourceDescription:
        channel.settimeout(OPEN_S)
        try:
            message, files, _, _ = socket.recv_fds(channel, MAX_MESSAGE, 1)
        except OSError as error:
            raise SourceLostError(f"the camera's driver did not start within {OPEN_S:g} s") from error
        said = self._said(message)
        if "opened" not in said or len(files) != 1:
            for file in files:
                os.close(file)
            raise SourceLostError(str(said.get("failed", "the camera's process has ended")))
        given = said["opened"]
        described = SourceDescription(
            **{**given, "depth_size": tuple(given["depth_size"]), "color_size": tuple(given["color_size"])}
        )
        (file,) = files
        try:
            if os.fstat(file).st_size != ring_bytes(described.depth_size, described.color_size):
                msg = "the camera's process has another ring of pictures"
                raise SourceLostError(msg)
            self._ring = Ring(file, described.depth_size, described.color_size)
        finally:
            os.close(file)
        self._taken = self._index = 0
        self._last = self._color = None
        self._period_us = US_PER_S / max(described.fps, 1.0)
        return described

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame; see :class:`engine.capture.source.DepthSource`."""
        if self._channel is None or self._ring is None:
            msg = "the camera is not open"
            raise SourceLostError(msg)
        self._channel.settimeout(max(timeout_s, 1e-3))
        try:
            message = self._channel.recv(MAX_MESSAGE)
        except TimeoutError as error:
            raise FrameTimeoutError(f"no frame within {timeout_s:g} s") from error
        except OSError as error:
            raise SourceLostError(self._cause()) from error
        if message[:4] != FRAME_MARK or len(message) != FRAME.size:
            said = self._said(message)
            if "ended" in said:
                raise SourceEndedError(str(said["ended"]))
            raise SourceLostError(str(said.get("failed", self._cause())))
        _, number, depth_us, color_us, received_ns, empty_ns, dropped, slot = FRAME.unpack(message)
        if not (0 <= depth_us <= LATEST_US and 0 <= color_us <= LATEST_US and 0 <= slot < SLOTS):
            msg = "the camera's process delivered an impossible frame"
            raise SourceLostError(msg)
        pictures = self._ring.pictures(slot)
        depth = frozen(np.array(pictures[0]))
        # A colour frame that several depth frames are paired with is one array, copied once.
        if self._color is None or self._color[0] != color_us:
            self._color = color_us, frozen(np.array(pictures[1]))
        color = self._color[1]
        self._taken += 1
        self._ring.taken = self._taken
        now = depth_us, number
        missed = dropped if self._last is None else max(missed_between(self._last, now, self._period_us), dropped)
        self._last = now
        frame = RgbdFrame(
            index=self._index,
            device_index=number,
            missed_frames=missed,
            timestamp_us=depth_us,
            color_timestamp_us=color_us,
            # The other process reads the host's clock itself; a time ahead of ours would be a frame from the future.
            received_ns=min(received_ns, self._clock.now_ns()),
            queue_empty_ns=None if empty_ns == UNKNOWN_NS else empty_ns,
            depth_mm=depth,
            color=color,
        )
        self._index += 1
        return frame

    def close(self) -> None:
        """Close the channel, and kill the process where it does not end; safe to call twice."""
        process, channel = self._process, self._channel
        self._channel = self._ring = None
        if channel is not None:
            channel.close()
        if process is None:
            return
        try:
            process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._process = None

    def _said(self, message: bytes) -> dict[str, Any]:
        """Return what the process said; empty where it has ended."""
        if not message.startswith(TEXT_MARK):
            return {}
        with contextlib.suppress(ValueError):
            return dict(json.loads(message[len(TEXT_MARK) :]))
        return {}

    def _cause(self) -> str:
        """Return how the process ended."""
        assert self._process is not None
        deadline_s = time.monotonic() + CLOSE_S
        while (status := self._process.poll()) is None and time.monotonic() < deadline_s:
            time.sleep(0.005)
        ended = "has ended" if not status or status > 0 else f"was killed (signal {-status})"
        return f"the camera's process {ended}"


def _command(module: str) -> list[str]:
    return [sys.executable, "-P", "-m", MODULE, module]


def _environment() -> dict[str, str]:
    path = os.pathsep.join([str(CODE), *_sdk_folders()])
    return {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}


def is_sdk_installed(package: str) -> bool:
    """Whether an SDK's package can be imported in the camera's process; imports nothing."""
    return find_spec(package) is not None or PathFinder.find_spec(package, _sdk_folders()) is not None


def _sdk_folders() -> list[str]:
    """Return the folders named by ``CAMERA_SDK_PATH``, where SDKs lie that are not in this program's environment."""
    return [one for one in os.environ.get("CAMERA_SDK_PATH", "").split(os.pathsep) if one]
