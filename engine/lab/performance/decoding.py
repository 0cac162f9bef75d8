"""Times the decoding of depth and colour pictures from a recording."""

import time
from dataclasses import dataclass

import numpy as np

from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.lab.performance.figures import Timing, timing_of
from engine.lab.performance.session import Recording

NAMES = {True: "depth, 16zT", False: "colour, JPEG"}


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureCost:
    """Decoding of one kind of picture."""

    name: str
    timing: Timing


def time_decoding(recording: Recording, most: int) -> tuple[PictureCost, ...]:
    """Time the decoding of the first ``most`` pictures of each stream."""
    coded: dict[bool, list[CodedFrame]] = {True: [], False: []}
    with OniReader(recording.path) as reader:
        for frame in reader.frames():
            if len(coded[frame.is_depth]) < most:
                coded[frame.is_depth].append(frame)
            if min(map(len, coded.values())) >= most:
                break
    return tuple(_cost(NAMES[is_depth], frames) for is_depth, frames in coded.items())


def _cost(name: str, frames: list[CodedFrame]) -> PictureCost:
    spent_ns = np.empty(len(frames))
    for number, frame in enumerate(frames):
        started = time.perf_counter_ns()
        _ = frame.decode_depth() if frame.is_depth else frame.decode_color()
        spent_ns[number] = time.perf_counter_ns() - started
    return PictureCost(name=name, timing=timing_of([spent_ns]))
