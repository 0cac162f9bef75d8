"""Recordings of an Orbbec camera, as OrbbecSDK v2 writes them: ROS 1 bags that its playback device accepts.

Messages are packed by hand, as the SDK's own have fields that the standard ones lack; names and sums are the SDK's.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer

from engine.calibration.camera_calibration import Calibration
from engine.core.geometry import Intrinsics

COLOR, DEPTH = 2, 3
RGB, Y16 = 22, 8
MADE_UP = "0123456789abcdef0123456789abcdef"
VERSION = 2.1
BEGIN_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagFrame:
    """A depth or colour frame; ``number`` and ``timestamp_us`` are the device's, ``at_us`` is when it is played."""

    number: int
    timestamp_us: int
    at_us: int
    picture: np.ndarray


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


HEADER = struct.pack("<III", 0, 0, 0) + _text("")


def _device(serial: str, connection: str) -> bytes:
    """A Femto Bolt: the kind whose frames the playback leaves as they are."""
    names = [_text(one) for one in ("Orbbec Femto Bolt", "Orbbec Femto Bolt", "Femto Bolt")]
    more = [_text(one) for one in ("uid", serial, "1.1.2", "1.0", "2.0.0", connection)]
    ids = struct.pack("<HH", 0x2BC5, 0x066B)
    return HEADER + b"".join(names) + ids + b"".join(more) + struct.pack("<HB", 0, 0) + _text("") + _text("")


def _profile(stream: int, camera: Intrinsics, calibration: Calibration) -> bytes:
    pose = calibration.color_from_depth
    k1, k2, p1, p2, k3 = camera.distortion
    return b"".join(
        (
            HEADER,
            struct.pack("<BB", stream, Y16 if stream == DEPTH else RGB),
            struct.pack("<9f", *pose.rotation.ravel()),
            struct.pack("<3f", *pose.translation_mm),
            struct.pack("<HHH", camera.width, camera.height, 30),
            struct.pack("<4f", camera.fx, camera.fy, camera.cx, camera.cy),
            struct.pack("<8f", k1, k2, k3, 0.0, 0.0, 0.0, p1, p2),
            struct.pack("<B", 3),
        )
    )


def _image(frame: BagFrame) -> bytes:
    rows, columns = frame.picture.shape[:2]
    data = np.ascontiguousarray(frame.picture).tobytes()
    is_depth = frame.picture.ndim == 2
    return b"".join(
        (
            HEADER,
            struct.pack("<II", rows, columns),
            _text("mono16" if is_depth else "rgb8"),
            struct.pack("<BII", 0, len(data) // rows, len(data)),
            data,
            struct.pack("<f", 1.0),
            struct.pack("<QQQQ", frame.number, *[frame.timestamp_us] * 3),
            struct.pack("<IIB", 0, 0, 16 if is_depth else 24),
        )
    )


def write_bag(
    path: Path, calibration: Calibration, frames: Iterable[BagFrame], *, serial: str, connection: str = "USB3.0"
) -> None:
    """Write a recording; depth frames are those with two dimensions."""
    with Writer(path) as bag:
        kinds = {
            "/cam/property": ("OBProperty", MADE_UP),
            "/cam/deviceInfo": ("OBDeviceInfo", "afef5328bb4abebd1a309e1ea8b26b3a"),
            f"/cam/streamProfileType_{COLOR}": ("OBStreamProfileInfo", MADE_UP),
            f"/cam/streamProfileType_{DEPTH}": ("OBStreamProfileInfo", MADE_UP),
        }
        about = {
            topic: bag.add_connection(topic, f"custom_msg/msg/{kind}", msgdef="uint8 packed\n", md5sum=md5)
            for topic, (kind, md5) in kinds.items()
        }
        pictures = {
            stream: bag.add_connection(
                f"/cam/sensor_{stream}/frameType_{stream}",
                "sensor_msgs/msg/Image",
                msgdef="uint8 packed\n",
                md5sum="060021388200f6f0f447d0fcd9c64743",
            )
            for stream in (COLOR, DEPTH)
        }
        version = struct.pack("<II", 0, 8) + struct.pack("<dI", VERSION, 8)
        bag.write(about["/cam/property"], BEGIN_NS, HEADER + version)
        bag.write(about["/cam/deviceInfo"], BEGIN_NS, _device(serial, connection))
        for stream, camera in ((COLOR, calibration.color), (DEPTH, calibration.depth)):
            bag.write(about[f"/cam/streamProfileType_{stream}"], BEGIN_NS, _profile(stream, camera, calibration))
        for frame in frames:
            stream = DEPTH if frame.picture.ndim == 2 else COLOR
            bag.write(pictures[stream], BEGIN_NS + 1000 * frame.at_us, _image(frame))
