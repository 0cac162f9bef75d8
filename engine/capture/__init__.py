"""Cameras and recordings as sources of frames: one folder for each SDK behind `drivers`, ``.oni`` files, recorders.

A source (:class:`DepthSource`) gives millimetres and host times, and loses no frame silently.
"""

from engine.capture.oni.reader import (
    OniReader,
    RecordingDescription,
    StreamSummary,
    describe,
)
from engine.capture.raw_recorder import (
    RawRecorder,
    part_of,
)
from engine.capture.reconnecting import (
    CheckedSource,
    ReturningSource,
)
from engine.capture.recording_source import (
    OniFileSource,
)
from engine.capture.source import (
    CameraOptions,
    DepthSource,
    LiveSource,
    SourceDescription,
    TemperatureSource,
)

__all__ = [
    "CameraOptions",
    "CheckedSource",
    "DepthSource",
    "LiveSource",
    "OniFileSource",
    "OniReader",
    "RawRecorder",
    "RecordingDescription",
    "ReturningSource",
    "SourceDescription",
    "StreamSummary",
    "TemperatureSource",
    "describe",
    "part_of",
]
