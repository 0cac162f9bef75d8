"""Targets: calibrations, regions, laser planes, traces, flows; JSON of our own and of unknown callers."""

import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

from engine.calibration.formats.conversion import read_upload
from engine.calibration.laser_plane import LaserPlaneError, load_plane
from engine.core.errors import CalibrationError, InvalidValueError, RecordingError
from engine.core.strict_json import StrictJson
from engine.motion.named_regions import load_regions
from engine.qa.recorded_traces import read_trace
from engine.qa.trace import read_commanded
from lab.evaluation.instruments.flow_file import FlowFileError, read_flow
from tests.support.calibration.foreign_calibrations import (
    CAMERAS,
    import_document,
    ros_pair,
    storage_values,
    write_storage,
)
from verification.fuzz.target import Target, as_file

STRICT = StrictJson()
NESTED_MARK = "tidegate.calibration-import/1"


def read_json(content: bytes) -> None:
    """Parse, and hold what came out against what was promised."""
    depth = _depth(STRICT.parse(content))
    assert depth <= STRICT.max_nesting, f"nested {depth} deep"


def _depth(value: object) -> int:
    if isinstance(value, float):
        assert math.isfinite(value), "a number that is not finite"
    if isinstance(value, dict):
        return 1 + max(map(_depth, value.values()), default=0)
    return 1 + max(map(_depth, value), default=0) if isinstance(value, list) else 0


def read_calibration(content: bytes) -> None:
    converted = read_upload(content)
    again = read_upload(converted.calibration.to_json().encode())
    assert again.calibration.to_json() == converted.calibration.to_json()


def calibrations() -> Iterator[bytes]:
    yield CAMERAS.to_json().encode()
    yield import_document(ros_pair())
    named = storage_values() | {"camera": "bench 7", "first_camera": "depth"}
    with tempfile.TemporaryDirectory() as folder:
        for suffix in ("yml", "xml", "json"):
            yield write_storage(Path(folder) / f"a.{suffix}", named)


def read_regions(content: bytes) -> None:
    load_regions(as_file(content, "regions.json"))


def regions() -> Iterator[bytes]:
    square = {"name": "belly", "vertices": [[220, 40], [220.5, 160], [320, 100]]}
    yield json.dumps({"schema": "tidegate.regions/1", "regions": [square]}).encode()


def read_plane(content: bytes) -> None:
    load_plane(as_file(content, "plane.json"))


def planes() -> Iterator[bytes]:
    plane = {
        "schema": "tidegate.laser-plane/1",
        "camera": "bench 7",
        "normal": [0.0, 0.6, 0.8],
        "distance_mm": 400.0,
        "rms_mm": 0.1,
        "pictures": 12,
        "calibration_sha256": "a" * 64,
    }
    yield json.dumps(plane).encode()


def read_traces(content: bytes) -> None:
    """Read as a phantom's command, and, where it is none, as a recorded breath."""
    path = as_file(content, "trace.csv")
    try:
        read_commanded(path)
    except (RecordingError, InvalidValueError):
        read_trace(path)


def traces() -> Iterator[bytes]:
    steps = range(24)
    heights = [5.0 * math.sin(0.7 * i) for i in steps]
    rows = "\n".join(f"{0.1 * i:.1f},{y:.2f}" for i, y in zip(steps, heights, strict=True))
    yield f"time_s,position_mm\n{rows}\n".encode()
    yield "".join(f"{0.1 * i:.1f} 0 0 {y:.2f} 0 0 0\n" for i, y in zip(steps, heights, strict=True)).encode()
    rows = "".join(f"{i};{33 * i};0,1;0,2;{y:.2f}\n".replace(".", ",") for i, y in zip(steps, heights, strict=True))
    yield f"Frame;Timestamp;x;y;z\n{rows}".encode()
    rows = "".join(f"{y / 10:.3f},0.5,{40 * i},0\n" for i, y in zip(steps, heights, strict=True))
    yield f"[Header]\nData_layout=amplitude,phase,timestamp,validflag\nScale_factor=10.0\n[Data]\n{rows}".encode()


def read_flows(content: bytes) -> None:
    read_flow(as_file(content, "flow.csv"))


def flows() -> Iterator[bytes]:
    yield ("time_s,flow_l_per_s\n" + "".join(f"{0.02 * i:.2f},{0.1 * i:.1f}\n" for i in range(22))).encode()
    yield ('"volume_l";"time_ms"\n' + "".join(f"0,{i};{20 * i}\n" for i in range(22))).encode()


TARGETS = (
    Target(
        name="strict_json",
        reads="untrusted JSON, before its schema is applied (`engine.core.strict_json`)",
        read=read_json,
        refusals=(InvalidValueError,),
        seeds=lambda: (b'{"a": [1, -2.5e3, "x\\u00e9", null, true, {"b": {}}]}', b"[1e999, NaN]", b'{"a":1,"a":2}'),
        max_bytes=2048,
        words=('"\\\\ud800"', "1e999", "-Infinity", "NaN", "null"),
    ),
    Target(
        name="calibration",
        reads="calibrations: ours, OpenCV's, ROS's; JSON, YAML, XML (`engine.calibration.formats`)",
        read=read_calibration,
        refusals=(CalibrationError,),
        seeds=calibrations,
        max_bytes=8192,
        words=(
            "opencv_storage",
            "camera_matrix",
            "distortion",
            "%YAML:1.0",
            "---",
            "<!DOCTYPE",
            NESTED_MARK,
            "&a",
            "*a",
        ),
    ),
    Target(
        name="regions",
        reads="named regions (`engine.motion.named_regions`)",
        read=read_regions,
        refusals=(InvalidValueError,),
        seeds=regions,
        max_bytes=2048,
    ),
    Target(
        name="laser_plane",
        reads="planes of a line laser (`engine.calibration.laser_plane`)",
        read=read_plane,
        refusals=(LaserPlaneError,),
        seeds=planes,
        max_bytes=1024,
    ),
    Target(
        name="trace",
        reads="traces: a phantom's commands, markers, RPM, a robot's (`engine.qa.trace`, `engine.qa.recorded_traces`)",
        read=read_traces,
        refusals=(RecordingError, InvalidValueError),
        seeds=traces,
        words=("[Header]", "[Data]", "Data_layout=", "Scale_factor=", "amplitude", "timestamp", "validflag", "1e308"),
    ),
    Target(
        name="flow",
        reads="a spirometer's flow or volume (`lab.evaluation.instruments.flow_file`)",
        read=read_flows,
        refusals=(FlowFileError,),
        seeds=flows,
        max_bytes=2048,
        words=("time_s", "time_ms", "flow_l_per_s", "volume_l", "1e308"),
    ),
)
