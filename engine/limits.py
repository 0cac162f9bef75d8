"""The numbers a gate decides by: the window, how often it may switch, and the limits of trust, each bounded here.

Lengths are motion against the reference [mm], positive towards the camera. A session may be given tighter limits than a
site's, and nothing may change them while it runs: the values are frozen and the loop takes them once.
"""

from dataclasses import dataclass

from engine.breath import BreathEventKind
from engine.clock import NS_PER_MS
from engine.errors import InvalidValueError
from engine.windows import GateWindow


@dataclass(frozen=True, slots=True, kw_only=True)
class GateLimits:
    """How far the gate trusts what it sees. The defaults are for 30 frames a second.

    Attributes
    ----------
    dwell_ms
        How long every frame must have been good and inside before the beam may be on, by the host's clock and by the
        device's.
    min_good_frames
        How many such frames in a row; at least two, so that no single frame turns a beam on.
    lease_ms
        How long after a frame was *received* the line may stay on without a newer one.
    max_frame_age_ms
        Oldest a frame may be when it is decided on.
    max_gap_ms
        Longest step from frame to frame, by the device's and by the host's clock; a frame is missing beyond it.
    max_lag_ms
        How much later than the promptest frame so far a frame may come (host time minus device time): a backlog in a
        driver looks fresh by its arrival and is not.
    max_silence_ms
        Silence, or an age, that is no hiccup: the gate faults.
    watchdog_ms
        Longest time between two decisions of an armed engine before the watchdog holds and latches. More than the
        lease, which takes the beam off by itself: a hiccup should cost a dwell, not a person's acknowledgement.
    min_valid_share
        Least share of the region the sensor must see, 0 to 1.
    min_inlier_share
        Least share of what the sensor saw that the motion model must explain, 0 to 1.
    max_residual_mm
        Largest mean misfit of any cell of the region that the motion model may leave.
    max_jump_mm
        Largest step of the signal from one frame to the next.
    min_on_ms
        Shortest time on that is worth it. It never keeps a beam on: after a shorter one the dwell is longer by it,
        until the beam has stayed on for so long once.
    min_off_ms
        Shortest time from off to the next on.
    max_cycles_per_min
        How often the beam may go on within a minute.
    max_repeated_frames
        How often the same picture, of depth or colour, may come again with new times.
    max_clock_jump_ms
        How much further than the host's clock the device's may step from one frame to the next.
    min_fps
        Least rate of frames over the last second [1/s].
    max_shift_mm, max_turn_deg
        How far the markers may have moved along the couch and turned since the reference was set.
    warn_latency_ms, max_latency_ms
        From capture to the line told: worth a warning, and a fault (AAPM TG-142 asks for gating to be timed
        within 100 ms; TG-76 for 500 ms in all).
    camera_latency_ms
        How long the camera itself takes for a frame, as measured by the site; part of the latency.
    max_model_age_min
        How long a model may be measured with after it was learned or compared with the patient.
    max_unwritten_ms
        How long a sample or a transition of an armed gate may wait to be written down; a kill loses no more than this.
    max_service_silence_ms
        How long the process that people reach an armed engine by may be silent, where that is another than the
        engine's: no hold by hand would come through, and nothing is written down.
    operator_timeout_s
        How long the page of the person who armed may be silent; 0 does not ask.
    is_calibrated
        Whether the camera's geometry was measured; without, the beam is held.
    max_baseline_correction_mm
        How far a person's correction of the baseline may move the window in all; of a window on the volume, as much as
        the region would hold.
    window_lower_mm, window_upper_mm
        No edge of a window may lie beyond, as settled and corrected: nobody arms with one that does.
    holding_events
        What in the breathing holds the beam.
    is_played
        The frames come from a recording. A player that falls behind plays late, and then its lag says nothing about
        the age of a frame; the loop sets this from what the source says of itself, whatever was given.
    """

    window: GateWindow
    dwell_ms: float = 100.0
    min_good_frames: int = 3
    lease_ms: float = 80.0
    max_frame_age_ms: float = 60.0
    max_gap_ms: float = 60.0
    max_lag_ms: float = 100.0
    max_silence_ms: float = 500.0
    watchdog_ms: float = 200.0
    min_valid_share: float = 0.8
    min_inlier_share: float = 0.6
    max_residual_mm: float = 3.0
    max_jump_mm: float = 4.0
    min_on_ms: float = 0.0
    min_off_ms: float = 0.0
    max_cycles_per_min: int = 120
    max_repeated_frames: int = 0
    max_clock_jump_ms: float = 250.0
    min_fps: float = 20.0
    max_shift_mm: float = 6.0
    max_turn_deg: float = 3.0
    warn_latency_ms: float = 100.0
    max_latency_ms: float = 500.0
    camera_latency_ms: float = 0.0
    max_model_age_min: float = 240.0
    max_unwritten_ms: float = 1_000.0
    max_service_silence_ms: float = 500.0
    operator_timeout_s: float = 0.0
    max_baseline_correction_mm: float = 5.0
    window_lower_mm: float = -100.0
    window_upper_mm: float = 100.0
    is_calibrated: bool = True
    holding_events: frozenset[BreathEventKind] = frozenset()
    is_played: bool = False

    def __post_init__(self) -> None:
        """Refuse every number out of its bound."""
        for name, (low, high) in LIMIT_BOUNDS.items():
            _check_number(name, getattr(self, name), low, high)
        for name in WHOLE_NUMBERS:
            if not isinstance(getattr(self, name), int):
                raise InvalidValueError(name, getattr(self, name), "a whole number")
        if self.max_latency_ms < self.warn_latency_ms:
            bound = f"at least warn_latency_ms ({self.warn_latency_ms:g})"
            raise InvalidValueError("max_latency_ms", self.max_latency_ms, bound)
        if self.max_silence_ms < self.max_gap_ms:
            bound = f"at least max_gap_ms ({self.max_gap_ms:g})"
            raise InvalidValueError("max_silence_ms", self.max_silence_ms, bound)


# Lowest and highest value each limit may take; a site can only choose within.
LIMIT_BOUNDS: dict[str, tuple[float, float]] = {
    "dwell_ms": (0.0, 10_000.0),
    "min_good_frames": (2, 300),
    "lease_ms": (20.0, 200.0),
    "max_frame_age_ms": (5.0, 200.0),
    "max_gap_ms": (10.0, 200.0),
    "max_lag_ms": (20.0, 500.0),
    "max_silence_ms": (50.0, 2_000.0),
    "watchdog_ms": (40.0, 500.0),
    "min_valid_share": (0.1, 1.0),
    "min_inlier_share": (0.1, 1.0),
    "max_residual_mm": (0.1, 20.0),
    "max_jump_mm": (0.1, 20.0),
    "min_on_ms": (0.0, 10_000.0),
    "min_off_ms": (0.0, 60_000.0),
    "max_cycles_per_min": (1, 120),
    "max_repeated_frames": (0, 3),
    "max_clock_jump_ms": (50.0, 2_000.0),
    "min_fps": (5.0, 60.0),
    "max_shift_mm": (1.0, 100.0),
    "max_turn_deg": (0.5, 45.0),
    "warn_latency_ms": (20.0, 500.0),
    "max_latency_ms": (100.0, 1_000.0),
    "camera_latency_ms": (0.0, 300.0),
    "max_model_age_min": (1.0, 1_440.0),
    "max_unwritten_ms": (600.0, 1_000.0),
    "max_service_silence_ms": (100.0, 2_000.0),
    "operator_timeout_s": (0.0, 600.0),
    "max_baseline_correction_mm": (0.0, 50.0),
    "window_lower_mm": (-100.0, 100.0),
    "window_upper_mm": (-100.0, 100.0),
}
WHOLE_NUMBERS = ("min_good_frames", "max_cycles_per_min", "max_repeated_frames")


def ns_from_ms(duration_ms: float) -> int:
    """Convert to whole nanoseconds, rounded down."""
    return int(duration_ms * NS_PER_MS)


def _check_number(name: str, value: object, low: float, high: float) -> None:
    # Written so that NaN fails: every comparison with it is false.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
