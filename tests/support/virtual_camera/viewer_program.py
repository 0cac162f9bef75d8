"""A process that looks through the runtime.

Run: ``python -m tests.support.virtual_camera.viewer_program devices|frames|recording|pictures ...``.

It speaks in JSON lines. ``recording FILE`` lets the runtime play one, with the virtual camera beside it.

``frames SECONDS [registered] [small] [until-eof]`` describes each frame and each failed read; with until-eof, until
its input is closed. ``pictures OUT [registered] [small]`` writes the newest frame of half a second to a file.
"""

import json
import sys
import threading
import time
import zlib
from pathlib import Path

import numpy as np

from engine.capture.openni.source import OpenNiSource, list_devices
from engine.core.clock import MonotonicClock
from engine.core.errors import FrameTimeoutError, TidegateError

READ_S = 0.1


def say(**words: object) -> None:
    sys.stdout.write(json.dumps(words) + "\n")
    sys.stdout.flush()


def devices() -> None:
    for device in list_devices():
        say(uri=device.uri, vendor=device.vendor, name=device.name)


def source(words: list[str]) -> OpenNiSource:
    size = (320, 240) if "small" in words else (640, 480)
    return OpenNiSource(
        None,
        clock=MonotonicClock(),
        depth_size=size,
        color_size=size,
        use_device_registration="registered" in words,
    )


def frames(camera: OpenNiSource, seconds: float, words: list[str]) -> None:
    about = camera.open()
    say(kind=about.kind, name=about.name, depth_size=about.depth_size, fps=about.fps, is_live=about.is_live)
    end_s = time.monotonic() + seconds
    is_over = threading.Event()
    if "until-eof" in words:
        threading.Thread(target=lambda: (sys.stdin.read(), is_over.set()), daemon=True).start()
    try:
        while time.monotonic() < end_s and not is_over.is_set():
            try:
                frame = camera.read(READ_S)
            except FrameTimeoutError:
                say(timeout=True)
                continue
            say(
                index=frame.index,
                device_index=frame.device_index,
                missed=frame.missed_frames,
                timestamp_us=frame.timestamp_us,
                color_timestamp_us=frame.color_timestamp_us,
                received_ns=frame.received_ns,
                queue_empty_ns=frame.queue_empty_ns,
                depth_crc=zlib.crc32(np.ascontiguousarray(frame.depth_mm)),
                color_crc=zlib.crc32(np.ascontiguousarray(frame.color)),
                zero_share=float((frame.depth_mm == 0).mean()),
                center_mm=float(np.median(frame.depth_mm[200:280, 280:360])),
            )
    except TidegateError as error:
        say(error=type(error).__name__, words=str(error))
    finally:
        camera.close()
        say(closed=True)


def pictures(out: Path, words: list[str]) -> None:
    camera = source(words)
    camera.open()
    try:
        end_s = time.monotonic() + 0.5
        frame = camera.read(5.0)
        while time.monotonic() < end_s:
            frame = camera.read(5.0)
        np.savez(out, index=frame.device_index, depth_mm=frame.depth_mm, color=frame.color)
    finally:
        camera.close()
        say(closed=True)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["devices"]:
            devices()
        case ["frames", seconds, *words]:
            frames(source(words), float(seconds), words)
        case ["recording", path]:
            frames(OpenNiSource(path, clock=MonotonicClock()), 30.0, [])
        case ["pictures", out, *words]:
            pictures(Path(out), words)
        case _:
            sys.exit(__doc__)
