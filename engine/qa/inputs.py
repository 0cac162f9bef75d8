"""What a run is given: a plate to look at, a phantom that moves as it was told, and the beam line.

Sources are opened and closed by the run, and so is the line. Nothing of it is kept.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

from engine.beam.line import BeamLine
from engine.beam.pulse import PULSE_BOUNDS_MS
from engine.calibration import Calibration
from engine.capture.source import DepthSource
from engine.clock import Clock
from engine.errors import InvalidValueError
from engine.limits import LIMIT_BOUNDS, GateLimits
from engine.pipeline import PipelineSettings
from engine.qa.checks import needs_of
from engine.qa.results import QaKind, QaNeed
from engine.qa.trace import CommandedTrace
from engine.watchdog import Watchdog

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
        How much of the source is read at most.
    """

    source: DepthSource
    calibration: Calibration
    part: float = 0.5
    seconds: float = 120.0

    def __post_init__(self) -> None:
        """Refuse every number out of its bound."""
        _check("plate.part", self.part, PART_BOUNDS)
        _check("plate.seconds", self.seconds, SECONDS_BOUNDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhantomInput:
    """Frames of a phantom with four markers that moves along a commanded trace, towards the camera.

    Attributes
    ----------
    trace
        What it was told. For the gate's timing its cycles are sines, best of several periods.
    window_mm
        Lower and upper edge of the gating window, in the trace's own positions. One edge lies beyond the trace's reach,
        so that every cycle has one interval in the window, around its turning point.
    limits
        The site's limits, whose dwell and latencies count; their window is replaced by ``window_mm``.
    starts_us
        The device time at which the trace's time 0 is; None for the first frame's.
    seconds
        How much of the source is read at most.
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
        """Refuse every number out of its bound, and a window that says nothing of the gate's timing."""
        _check("phantom.seconds", self.seconds, SECONDS_BOUNDS)
        lower, upper = self.window_mm
        for name, edge in (("phantom.window_mm.lower", lower), ("phantom.window_mm.upper", upper)):
            _check(name, edge, (-100.0, 100.0))
        least, most = self.trace.reach_mm
        has_low, has_high = least < lower < most, least < upper < most
        if not lower < upper or has_low is has_high:
            bound = f"one edge, and only one, between {least:.2f} and {most:.2f} mm, where the trace moves"
            raise InvalidValueError("phantom.window_mm", f"{lower:g} to {upper:g}", bound)


@contextmanager
def in_its_thread(watchdog: Watchdog) -> Iterator[None]:
    """Let a watchdog watch in its own thread, as a session does."""
    watchdog.start()
    try:
        yield
    finally:
        watchdog.stop()


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamInput:
    """The site's beam line, with the beam made safe: the drill turns the line on.

    Attributes
    ----------
    clock
        The line's clock.
    wait_ns
        Waits so long [ns].
    pulse_ms
        Length of each lease.
    repeats
        How often each drill is done.
    watchdog_ms
        The watchdog's deadline in its drill, shorter than a lease, so that it is not the lease that is seen.
    watched
        Lets a watchdog watch while a block runs.
    """

    line: BeamLine
    clock: Clock
    wait_ns: Callable[[int], None]
    pulse_ms: float = 200.0
    repeats: int = 20
    watchdog_ms: float = 60.0
    watched: Callable[[Watchdog], AbstractContextManager[None]] = in_its_thread

    def __post_init__(self) -> None:
        """Refuse every number out of its bound."""
        _check("beam.pulse_ms", self.pulse_ms, PULSE_BOUNDS_MS)
        _check("beam.repeats", self.repeats, REPEATS_BOUNDS)
        low, _ = LIMIT_BOUNDS["watchdog_ms"]
        _check("beam.watchdog_ms", self.watchdog_ms, (low, 0.5 * self.pulse_ms))


@dataclass(frozen=True, slots=True, kw_only=True)
class QaInputs:
    """What there is to measure with; see :func:`engine.qa.checks.needs_of` for what a kind of run needs."""

    plate: PlateInput | None = None
    phantom: PhantomInput | None = None
    beam: BeamInput | None = None

    def check(self, kind: QaKind) -> None:
        """Refuse a run for which something is missing; raise InvalidValueError naming it."""
        for need in needs_of(kind):
            if self.of(need) is None:
                raise InvalidValueError(need.value, None, f"given for {kind} QA")

    def of(self, need: QaNeed) -> PlateInput | PhantomInput | BeamInput | None:
        """Return what was given for one of the needs."""
        return {QaNeed.PLATE: self.plate, QaNeed.PHANTOM: self.phantom, QaNeed.BEAM: self.beam}[need]


def _check(name: str, value: object, bounds: tuple[float, float]) -> None:
    low, high = bounds
    # Written so that NaN fails: every comparison with it is false.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
