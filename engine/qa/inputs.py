"""Inputs of a QA run: frames of a flat plate, frames of a moving phantom, and the beam line.

The run opens and closes sources and line. Frames are not stored.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

from engine.beam.beam_on import ReadBeamOn
from engine.beam.commissioning import PULSE_BOUNDS_MS
from engine.beam.heartbeat_drill import DrilledReceiver
from engine.beam.line import BeamLine
from engine.calibration.camera_calibration import Calibration
from engine.capture.source import DepthSource
from engine.control.watchdog import Watchdog
from engine.core.bounds import check_number
from engine.core.clock import Clock
from engine.core.errors import InvalidValueError
from engine.gating.limits import LIMIT_BOUNDS, GateLimits
from engine.motion.settings import PipelineSettings
from engine.qa.checks import needs_of
from engine.qa.latency.measure import LightInput
from engine.qa.results import QaKind, QaNeed
from engine.qa.trace import CommandedTrace

SECONDS_BOUNDS = (10.0, 1800.0)
PART_BOUNDS = (0.2, 1.0)
REPEATS_BOUNDS = (5, 1000)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateInput:
    """Frames of a flat plate, or the bare couch, that faces the camera.

    Attributes
    ----------
    part
        Share of the picture's width and height, in the middle, that the plate fills.
    seconds
        Longest time read from the source [s of device time].
    """

    source: DepthSource
    calibration: Calibration
    part: float = 0.5
    seconds: float = 120.0

    def __post_init__(self) -> None:
        """Check every number against its bounds; raise InvalidValueError."""
        check_number("plate.part", self.part, *PART_BOUNDS)
        check_number("plate.seconds", self.seconds, *SECONDS_BOUNDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhantomInput:
    """Frames of a phantom with four markers that moves along a commanded trace, towards the camera.

    Attributes
    ----------
    trace
        The commanded motion. The gate's timing needs sines, best of several periods.
    window_mm
        Lower and upper edge of the gating window, in the trace's own positions. One edge lies beyond the trace's reach,
        so that every cycle has one interval in the window, around its turning point.
    limits
        The site's limits: dwell and latencies are used, the window is replaced by ``window_mm``.
    starts_us
        Device time of the trace's time 0 [us]; None for that of the first frame.
    seconds
        Longest time read from the source [s of device time].
    """

    source: DepthSource
    calibration: Calibration
    trace: CommandedTrace
    window_mm: tuple[float, float]
    limits: GateLimits
    settings: PipelineSettings = field(default_factory=PipelineSettings)
    starts_us: int | None = None
    seconds: float = 600.0

    def __post_init__(self) -> None:
        """Check every number against its bounds, and that exactly one edge of the window cuts the trace."""
        check_number("phantom.seconds", self.seconds, *SECONDS_BOUNDS)
        lower, upper = self.window_mm
        for name, edge in (("phantom.window_mm.lower", lower), ("phantom.window_mm.upper", upper)):
            check_number(name, edge, -100.0, 100.0)
        least, most = self.trace.reach_mm
        has_low, has_high = least < lower < most, least < upper < most
        if not lower < upper or has_low is has_high:
            bound = f"one edge, and only one, between {least:.2f} and {most:.2f} mm, where the trace moves"
            raise InvalidValueError("phantom.window_mm", f"{lower:g} to {upper:g}", bound)


@contextmanager
def running_thread(watchdog: Watchdog) -> Iterator[None]:
    """Run the watchdog in a thread of its own for the length of the block, as a session does."""
    watchdog.start()
    try:
        yield
    finally:
        watchdog.stop()


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamInput:
    """The site's beam line. The drill turns it on: the beam must be made safe first.

    Attributes
    ----------
    clock
        The clock that the line uses.
    wait_ns
        Waits for a span of time [ns].
    pulse_ms
        Length of each lease [ms].
    repeats
        Number of rounds; each round does every drill once.
    watchdog_ms
        Deadline of the watchdog's drill [ms], shorter than a lease, so that the watchdog turns the line off first.
    watched
        Context manager that runs a watchdog while its block runs.
    receivers
        The receivers of the line, one of each of its parts, for the drill of the heartbeat; without one it fails.
    beam_on
        Reads the accelerator's beam-on signal; None where it is no input.
    """

    line: BeamLine
    clock: Clock
    wait_ns: Callable[[int], None]
    pulse_ms: float = 200.0
    repeats: int = 20
    watchdog_ms: float = 60.0
    watched: Callable[[Watchdog], AbstractContextManager[None]] = running_thread
    receivers: tuple[DrilledReceiver, ...] = ()
    beam_on: ReadBeamOn | None = None

    def __post_init__(self) -> None:
        """Check every number against its bounds; raise InvalidValueError."""
        check_number("beam.pulse_ms", self.pulse_ms, *PULSE_BOUNDS_MS)
        check_number("beam.repeats", self.repeats, *REPEATS_BOUNDS)
        low, _ = LIMIT_BOUNDS["watchdog_ms"]
        check_number("beam.watchdog_ms", self.watchdog_ms, low, 0.5 * self.pulse_ms)


@dataclass(frozen=True, slots=True, kw_only=True)
class QaInputs:
    """Inputs by stage, None where the run has none; `checks.needs_of` lists what a kind of run needs."""

    plate: PlateInput | None = None
    phantom: PhantomInput | None = None
    beam: BeamInput | None = None
    camera: LightInput | None = None

    def check(self, kind: QaKind) -> None:
        """Raise InvalidValueError naming the first input that this kind of run needs and that is missing."""
        for need in needs_of(kind):
            if self.of(need) is None:
                raise InvalidValueError(need.value, None, f"given for {kind} QA")

    def of(self, need: QaNeed) -> PlateInput | PhantomInput | BeamInput | LightInput | None:
        """Return the input of one stage, None if there is none."""
        return {
            QaNeed.PLATE: self.plate,
            QaNeed.PHANTOM: self.phantom,
            QaNeed.BEAM: self.beam,
            QaNeed.CAMERA: self.camera,
        }[need]
