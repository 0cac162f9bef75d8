"""Sessions that are started at many moments of one recording, and where their confirmed references lie in the breath.

Each session is the real engine loop with the real pipeline, on the recording's clock and as fast as it measures. The
reference is confirmed with the proposed level as soon as one is proposed. Every third frame is fed, as of a camera with
10 frames a second: fewer frames make it harder, and the recording is decoded once for all sessions.
"""

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import find_peaks

from engine.calibration.camera_calibration import Calibration, load_calibration
from engine.capture.recording_source import OniFileSource
from engine.capture.source import SourceDescription
from engine.control.loop import EngineLoop
from engine.control.outputs import FrameRecord
from engine.core.clock import NS_PER_US, ManualClock
from engine.core.commands import SetReference
from engine.core.errors import SourceEndedError
from engine.core.frames import FloatArray, RgbdFrame
from engine.core.reference import ReferenceMoment, ReferenceProposal
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from lab.phantom.truth import Truth, load_truth
from tests.support.control.loop_bench import SteppedWatchdog, WatchedBeamLine, drained

EVERY = 3
STARTS = 20
STEP_S = 0.2
"""Twenty starts this far apart fall on all moments of a breath."""
LONGEST_S = 20.0
COMPARED_FRAMES = 10
"""Measured frames behind the confirmation that are compared with the truth: a second."""
BASE_NS = 1_000_000_000
LIMITS = GateLimits(window=amplitude_window(lower_mm=-1.0, upper_mm=3.0))
SHARE_OF_BREATH = 0.5
"""Least prominence of an end of exhale, as a share of the recording's motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirmed:
    """A session's confirmed reference.

    Attributes
    ----------
    start_s, model_s, confirmed_s
        When the session was started, counted from the recording's begin, and how long after that it had a model and a
        reference.
    breaths
        How many breaths were proposed.
    error_percent
        True level of the reference against the true mean end of exhale of the session, in per cent of the mean breath;
        positive towards the inhale.
    """

    start_s: float
    model_s: float
    confirmed_s: float
    breaths: int
    error_percent: float


class _Source:
    """Delivers frames on a manual clock, and confirms the first proposal between two of them."""

    def __init__(self, frames: Sequence[RgbdFrame], clock: ManualClock) -> None:
        self._frames, self._clock = frames, clock
        self._next = 0
        self._after = 0
        self.loop: EngineLoop | None = None
        self.answer: Future[None] | None = None
        self.proposal: ReferenceProposal | None = None
        self.confirmed_us = 0
        self.records: list[FrameRecord] = []

    def open(self) -> SourceDescription:
        return SourceDescription(
            kind="script", name="test", depth_size=(640, 480), color_size=(640, 480), fps=10.0, is_live=False
        )

    def read(self, timeout_s: float) -> RgbdFrame:  # noqa: ARG002
        self._look()
        if self._after > COMPARED_FRAMES or self._next == len(self._frames):
            raise SourceEndedError("enough was seen")
        frame = self._frames[self._next]
        self._next += 1
        self._clock.advance_ns(max(0, BASE_NS + frame.timestamp_us * NS_PER_US - self._clock.now_ns()))
        return replace(frame, received_ns=self._clock.now_ns())

    def _look(self) -> None:
        assert self.loop is not None
        self.records += drained(self.loop.samples)
        drained(self.loop.transitions)
        if self.answer is not None and self.answer.done():
            self.confirmed_us = self.confirmed_us or self._frames[self._next - 1].timestamp_us
            self._after += 1
        if self.answer is not None:
            return
        proposals = self.loop.status.learning.reference_proposals
        found = next((one for one in proposals if one.moment is ReferenceMoment.END_EXHALE), None)
        if found is not None:
            self.proposal = found
            self.answer = self.loop.submit(
                SetReference(operator="ann", moment=ReferenceMoment.END_EXHALE, level_seen=found.level)
            )

    def close(self) -> None:
        """Nothing was opened."""


def confirmed_references(
    folder: Path, *, starts: int = STARTS, step_s: float = STEP_S, every: int = EVERY
) -> list[Confirmed]:
    """Run a session from each start over a volunteer's recording; raise AssertionError where one confirms nothing."""
    calibration, truth = load_calibration(folder / "calibration.json"), load_truth(folder / "truth.npz")
    frames = _decoded(folder / "recording.oni", (starts - 1) * step_s + LONGEST_S, every)
    first_us = frames[0].timestamp_us
    found = []
    for number in range(starts):
        since_us = first_us + round(number * step_s * 1e6)
        found.append(_session([one for one in frames if one.timestamp_us >= since_us], calibration, truth, first_us))
    return found


def _decoded(recording: Path, seconds: float, every: int) -> list[RgbdFrame]:
    source, frames, first_us = OniFileSource(recording, clock=ManualClock(), is_helped=False), [], None
    source.open()
    try:
        while True:
            frame = source.read(1.0)
            first_us = frame.timestamp_us if first_us is None else first_us
            if frame.timestamp_us - first_us > seconds * 1e6:
                return frames
            if frame.index % every == 0:
                _ = frame.color  # decoded once, for all sessions
                frames.append(frame)
    except SourceEndedError:
        return frames
    finally:
        source.close()


def _session(frames: Sequence[RgbdFrame], calibration: Calibration, truth: Truth, first_us: int) -> Confirmed:
    clock = ManualClock(BASE_NS)
    beam, source = WatchedBeamLine(clock), _Source(frames, clock)
    pipeline = Pipeline(calibration, PipelineSettings(), clock, InlineTrainer())
    watchdog = SteppedWatchdog(beam=beam, clock=clock, deadline_ns=10**12)
    source.loop = EngineLoop(
        source=source, measurer=pipeline, learner=pipeline.learner, beam=beam, limits=LIMITS, clock=clock,
        watchdog=watchdog,
    )  # fmt: skip
    source.loop.start()
    assert source.loop.join(timeout_s=600.0), "the loop did not end"
    source.records += drained(source.loop.samples)
    assert source.answer is not None, f"no reference was proposed: {source.loop.status}"
    assert source.answer.exception() is None, source.answer.exception()
    assert source.proposal is not None
    measured = [one.measurement for one in source.records if one.measurement.motion is not None]
    start_us = frames[0].timestamp_us
    return Confirmed(
        start_s=(start_us - first_us) / 1e6,
        model_s=(measured[0].timestamp_us - start_us) / 1e6,
        confirmed_s=(source.confirmed_us - start_us) / 1e6,
        breaths=source.proposal.breaths,
        error_percent=_error_percent(
            truth,
            start_us,
            [(one.timestamp_us, one.motion.whole_mm) for one in measured if one.timestamp_us > source.confirmed_us],
        ),
    )


def _error_percent(truth: Truth, start_us: int, measured: Sequence[tuple[int, float]]) -> float:
    """Return the true level that was measured as 0, from the mean end of exhale, in per cent of the mean breath."""
    stamps, level_mm = truth.timestamp_us, -np.asarray(truth.whole_depth_mm)
    at_us, motion_mm = np.array(measured).T
    reference_mm = float(np.mean(np.interp(at_us, stamps, level_mm) - motion_mm))
    is_session = (stamps >= start_us) & (stamps <= at_us[-1])
    low_mm, high_mm = _ends(-level_mm[is_session]), _ends(level_mm[is_session])
    exhale_mm, inhale_mm = -float(np.mean(low_mm)), float(np.mean(high_mm))
    return 100.0 * (reference_mm - exhale_mm) / (inhale_mm - exhale_mm)


def _ends(signal_mm: FloatArray) -> FloatArray:
    peaks, _ = find_peaks(signal_mm, prominence=SHARE_OF_BREATH * np.ptp(signal_mm))
    return np.asarray(signal_mm[peaks])
