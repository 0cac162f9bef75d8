"""Times the frame path from decoded pictures to the gate, and the plain method's.

Every frame is decoded immediately before it is timed, as in a session, so that the caches are in the state that the
decoder leaves.
"""

import math
import sys
import time
from dataclasses import dataclass

import cv2
import numpy as np

from engine.calibration.camera_calibration import load_calibration
from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.core.compiled import numpy_forms
from engine.core.frames import FloatArray, MeasurementState, RgbdFrame
from engine.core.gate_state import GateState
from engine.motion.learning.trainer import InlineTrainer
from lab.evaluation.methods.plain import ARTICLE_FPS, PlainReading
from lab.performance.machine import (
    SpeedBenchError,
    Timing,
    set_memory_aside,
    settle_as_the_service,
    timing_of,
)
from lab.performance.session import READ_TIMEOUT_S, BenchSession, EndlessSource, Recording

# The number of training frames does not change the cost of a frame.
TRAINING_FRAMES = 20
MAX_UNMEASURED = 100
COUNTED_FRAMES = 60
MOST_UNTIL_ON = 3000
NAMES = {True: "depth, 16zT", False: "colour, JPEG"}
MIN_MEASURED_SHARE = 0.95


# The plain method of the article on the benchmark's recording, timed like Tidegate: from decoded pictures onwards.
class PlainSession:
    """Measures frames one by one, up to the reconstructed surface (equation 7)."""

    def __init__(self, recording: Recording) -> None:
        self._source = EndlessSource(recording)
        self._source.open()
        calibration = load_calibration(recording.calibration)
        self._reading = PlainReading(calibration, ARTICLE_FPS, training_frames=TRAINING_FRAMES)

    def learn(self) -> None:
        """Read frames until a model is fitted; raise SpeedBenchError if the four markers are never found."""
        for _ in range(TRAINING_FRAMES + MAX_UNMEASURED):
            self._measure(self._read())
            if self._reading.model is not None:
                return
        raise SpeedBenchError("the plain method never found its four markers")

    def block(self, frames: int) -> FloatArray:
        """Return the durations of ``frames`` frames [ns], shape (frames,)."""
        durations_ns = np.empty(frames)
        for number in range(frames):
            frame = self._read()
            started = time.perf_counter_ns()
            self._measure(frame)
            durations_ns[number] = time.perf_counter_ns() - started
        return durations_ns

    def close(self) -> None:
        """Close the recording."""
        self._source.close()

    def _read(self) -> RgbdFrame:
        return self._source.read(READ_TIMEOUT_S)

    def _measure(self, frame: RgbdFrame) -> None:
        measured = self._reading.measure(frame)
        if measured is not None and self._reading.model is not None:
            self._reading.model.reconstruct(measured.beta)


class OdometryPeer:
    """OpenCV's RGB-D odometry from a first frame to each later one, of depth in the middle of the picture.

    What a user would write who has a library of RGB-D functions and not this program: a rigid movement, no breathing.
    """

    def __init__(self, recording: Recording) -> None:
        self._source = EndlessSource(recording)
        self._source.open()
        camera = load_calibration(recording.calibration).depth
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(camera.matrix.astype(np.float32))
        self._odometry = cv2.Odometry(cv2.OdometryType_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
        self._first = self._taken(self._source.read(READ_TIMEOUT_S))

    def block(self, frames: int) -> FloatArray:
        """Return the durations of ``frames`` frames [ns], shape (frames,)."""
        durations_ns = np.empty(frames)
        for number in range(frames):
            frame = self._source.read(READ_TIMEOUT_S)
            started = time.perf_counter_ns()
            taken = self._taken(frame)
            self._odometry.prepareFrames(self._first, taken)
            self._odometry.compute(self._first, taken)
            durations_ns[number] = time.perf_counter_ns() - started
        return durations_ns

    def close(self) -> None:
        """Close the recording."""
        self._source.close()

    @staticmethod
    def _taken(frame: RgbdFrame) -> cv2.OdometryFrame:
        depth_m = np.where(frame.depth_mm > 0, frame.depth_mm / np.float32(1000.0), np.float32(np.nan))
        rows, columns = frame.depth_mm.shape
        mask = np.zeros((rows, columns), dtype=np.uint8)
        mask[rows // 4 : -(rows // 4), columns // 4 : -(columns // 4)] = 255
        return cv2.OdometryFrame(depth_m.astype(np.float32), np.ascontiguousarray(frame.color), mask)


# Times the decoding of depth and colour pictures from a recording.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSizes:
    """Amount of work: ``blocks`` of ``block_frames`` each, and ``decoded`` pictures of each kind."""

    blocks: int
    block_frames: int
    plain_frames: int
    decoded: int
    peer_frames: int = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCosts:
    """Cost of a frame on one core.

    Attributes
    ----------
    to_gate
        From the decoded pictures to the decision.
    whole, whole_cpu
        The same with what is learned from the frame after it: wall clock and processor time.
    numpy_cpu
        Processor time with the numpy forms of the compiled functions, in blocks between; equal where none is compiled.
    plain
        The plain method, from decoded pictures to a surface of the region.
    peer
        OpenCV's RGB-D odometry.
    lost_core_share
        Share of the timed span in which other processes used the core, 0 to 1.
    calls
        Median number of Python calls of a frame.
    """

    to_gate: Timing
    whole: Timing
    whole_cpu: Timing
    numpy_cpu: Timing
    plain: Timing
    peer: Timing
    decoding: tuple[PictureCost, ...]
    numpy_decoding: tuple[PictureCost, ...]
    lost_core_share: float
    calls: float

    @property
    def median_ratio(self) -> float:
        """Ratio of the plain method's median time to ours."""
        return self.plain.median_us / self.whole.median_us

    @property
    def compiled_ratio(self) -> float:
        """Ratio of the median processor time with the numpy forms to that of the path that runs."""
        return self.numpy_cpu.median_us / self.whole_cpu.median_us

    @property
    def spread(self) -> float:
        """Ratio of the 99th percentile to the median, to the decision."""
        return self.to_gate.p99_us / self.to_gate.median_us

    @property
    def p99_ratio(self) -> float:
        """Ratio of the plain method's 99th percentile to ours."""
        return self.plain.p99_us / self.whole.p99_us


def time_frames(recording: Recording, sizes: FrameSizes, switch_interval_s: float) -> FrameCosts:
    """Time frame path and plain method in alternating blocks; run it in a process of its own."""
    settle_as_the_service(switch_interval_s)
    ours = BenchSession(recording, InlineTrainer())
    ours.learn()
    plain = PlainSession(recording)
    plain.learn()
    peer = OdometryPeer(recording)
    set_memory_aside()
    _warm_up(ours, sizes.block_frames)
    gate_blocks, wall_blocks, cpu_blocks, numpy_blocks, plain_blocks = [], [], [], [], []
    for _ in range(sizes.blocks):
        ours.arm()
        gate_ns, wall_ns, cpu_ns = _whole_block(ours, sizes.block_frames)
        gate_blocks.append(gate_ns)
        wall_blocks.append(wall_ns)
        cpu_blocks.append(cpu_ns)
        with numpy_forms():
            numpy_blocks.append(_whole_block(ours, sizes.block_frames)[2])
        plain_blocks.append(plain.block(sizes.plain_frames))
    peer_ns = peer.block(sizes.peer_frames)
    peer.close()
    calls = calls_a_frame(ours, COUNTED_FRAMES)
    ours.close()
    plain.close()
    with numpy_forms():
        numpy_decoding = time_decoding(recording, sizes.decoded)
    return FrameCosts(
        to_gate=timing_of(gate_blocks),
        whole=timing_of(wall_blocks),
        whole_cpu=timing_of(cpu_blocks),
        numpy_cpu=timing_of(numpy_blocks),
        plain=timing_of(plain_blocks),
        peer=timing_of([peer_ns]),
        decoding=time_decoding(recording, sizes.decoded),
        numpy_decoding=numpy_decoding,
        calls=calls,
        lost_core_share=max(0.0, 1.0 - float(np.concatenate(cpu_blocks).sum() / np.concatenate(wall_blocks).sum())),
    )


def calls_a_frame(ours: BenchSession, frames: int) -> float:
    """Return the median number of Python calls of frames measured with the beam on; NaN if there are none."""
    counts, calls = [], 0

    def count(_frame: object, event: str, _argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    ours.arm()
    for _ in range(MOST_UNTIL_ON):  # a dwell is real time, and these frames come as fast as they are decoded
        if ours.gate.state is GateState.BEAM_ON:
            break
        ours.decide(ours.read())
    for _ in range(frames):
        frame, calls = ours.read(), 0
        sys.setprofile(count)
        state = ours.decide(frame)
        ours.go_on()
        sys.setprofile(None)
        if state is MeasurementState.MEASURING and ours.gate.state is GateState.BEAM_ON:
            counts.append(calls)
    return float(np.median(counts)) if counts else math.nan


def _warm_up(ours: BenchSession, frames: int) -> None:
    """Fill the caches; raise SpeedBenchError if too few frames are measured, as lost frames take a shorter path."""
    measured = sum(ours.decide(ours.read()) is MeasurementState.MEASURING for _ in range(frames))
    if measured < MIN_MEASURED_SHARE * frames:
        msg = f"only {measured} of {frames} frames of the bench's recording were measured, too few to time"
        raise SpeedBenchError(msg)


def _whole_block(ours: BenchSession, frames: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time frames: to the decision, whole, and the processor's time [ns]."""
    gate_ns, wall_ns, cpu_ns = np.empty((3, frames))
    for number in range(frames):
        frame = ours.read()
        cpu_started, started = time.thread_time_ns(), time.perf_counter_ns()
        ours.decide(frame)
        gate_ns[number] = time.perf_counter_ns() - started
        ours.go_on()
        wall_ns[number] = time.perf_counter_ns() - started
        cpu_ns[number] = time.thread_time_ns() - cpu_started
    return gate_ns, wall_ns, cpu_ns
