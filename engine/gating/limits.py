"""The limits of the gate: the window, the switching, and the frame checks, each with its bounds.

Lengths are motion against the reference [mm], positive towards the camera. A session may have tighter limits than the
site; they do not change while it runs, because the values are frozen and the loop reads them once.

What the window of a session is where a request leaves it out; offline runs decide by the same.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from engine.core.bounds import check_number, check_numbers
from engine.core.breath import BreathEventKind
from engine.core.clock import NS_PER_MS
from engine.core.errors import InvalidValueError
from engine.core.signals import HeadDirection, depends_on_head
from engine.gating.windows import BreathDepth, BreathHoldWindow, GateWindow
from engine.gating.windows.amplitude import Unit

MAX_UNCHECKED_US = 500_000
"""A check that cannot work for longer holds the beam: surface, colour, scene, markers, and the age of the pictures.
A hand of the staff passes by in less."""
BREATHING_CEASED = frozenset({BreathEventKind.APNOEA, BreathEventKind.NO_CYCLE})
"""Breathing events without breaths: an amplitude has no meaning then (ADR 0030)."""
EVENTS_OF_A_BREATH_HOLD = BREATHING_CEASED | {
    BreathEventKind.IRREGULAR,
    BreathEventKind.SIGH,
    BreathEventKind.TALKING,
}
"""Breathing events that a deliberate breath hold, or the breath before and after it, may resemble."""
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
    "min_signal_share": (0.5, 1.0),
    "min_wide_share": (0.7, 1.0),
    "max_residual_mm": (0.1, 20.0),
    "max_jump_mm": (0.1, 20.0),
    "min_on_ms": (0.0, 10_000.0),
    "min_off_ms": (0.0, 60_000.0),
    "max_cycles_per_min": (1, 120),
    "max_beam_on_s": (2.0, 30.0),
    "max_duty_percent": (10.0, 100.0),
    "max_clock_jump_ms": (50.0, 2_000.0),
    "min_fps": (5.0, 60.0),
    "max_shift_mm": (1.0, 100.0),
    "max_turn_deg": (0.5, 45.0),
    "max_marker_travel_mm": (0.5, 20.0),
    "max_height_mm": (0.5, 50.0),
    "max_baseline_drift_mm": (0.5, 10.0),
    "warn_latency_ms": (20.0, 500.0),
    "max_latency_ms": (100.0, 1_000.0),
    "camera_latency_ms": (0.0, 300.0),
    "max_model_age_min": (1.0, 1_440.0),
    "max_unwritten_ms": (600.0, 1_000.0),
    "max_service_silence_ms": (100.0, 2_000.0),
    "operator_timeout_s": (0.0, 600.0),
    "max_baseline_correction_mm": (0.0, 50.0),
    "max_reference_distance_mm": (0.5, 50.0),
    "max_position_shift_mm": (0.5, 20.0),
    "max_position_turn_deg": (0.2, 10.0),
    "max_position_shape_mm": (0.5, 20.0),
    "min_breaths_per_min": (0.5, 30.0),
    "max_breaths_per_min": (10.0, 60.0),
    "window_lower_mm": (-100.0, 100.0),
    "window_upper_mm": (-100.0, 100.0),
}
WARM_UP_BOUNDS_S = (0.0, 14_400.0)
WHOLE_NUMBERS = ("min_good_frames", "max_cycles_per_min")
HYSTERESIS: Mapping[Unit, float] = {Unit.MM: 0.2, Unit.L: 0.01, Unit.PERCENT: 2.0}
"""Distance inside the edges that a signal must reach to enter, by unit."""
DWELL_MS = 200.0
"""Time that the signal must stay inside before beam on [ms]."""


@dataclass(frozen=True, kw_only=True)
class GateLimits:
    """Limits of one session. The defaults are for 30 frames a second.

    Attributes
    ----------
    dwell_ms
        Time during which every frame must be good and inside before beam on, by the host's clock and by the
        device's.
    min_good_frames
        Number of such frames in a row; at least two, so that no single frame causes beam on.
    lease_ms
        Time after the *receipt* of a frame for which the line may stay on without a newer one.
    max_frame_age_ms
        Greatest age of a frame at its decision.
    max_gap_ms
        Longest step from frame to frame, by the device's and by the host's clock; a frame is missing beyond it.
    max_lag_ms
        Greatest delay of a frame against the fastest one so far (host time minus device time): detects a backlog in a
        driver, whose frames arrive regularly and are old.
    max_silence_ms
        Time without frames, or age of a frame, at which the gate faults.
    watchdog_ms
        Longest time between two decisions of an armed engine before the watchdog holds and latches. More than the
        lease, which ends beam on by itself: a short delay should cost a dwell, not an acknowledgement.
    min_valid_share
        Least share of the region the sensor must see, 0 to 1.
    min_inlier_share
        Least share of the visible region that the motion model must explain, 0 to 1.
    min_signal_share, min_wide_share
        Least share of the area of each gated signal that must be seen and explained, in the frame and when the
        reference was set, 0 to 1. The first is for cells, named regions and points, of which it is the 21 px around
        them; the second for whole, thorax, abdomen and volume, in which a hidden part is large enough to move alone.
    max_residual_mm
        Largest residual: mean misfit of any cell of the region.
    max_jump_mm
        Largest step of the signal from one frame to the next.
    min_on_ms
        Shortest useful beam on. It never prolongs beam on: after a shorter one the dwell is longer by this time, until
        one beam on has lasted as long.
    min_off_ms
        Shortest time from off to the next on.
    max_cycles_per_min
        Most beam-on transitions within a minute.
    max_beam_on_s
        Longest beam-on in an amplitude or phase window without the signal's leaving it [s]; two breaths also bound it
        where the rate is known.
    max_duty_percent
        Largest share of the learned breaths inside an amplitude or phase window [%]; arming is refused beyond it, as
        the signal practically never leaves such a window. 100 switches this off.
    max_clock_jump_ms
        Greatest step of the device's clock beyond the host's from one frame to the next.
    min_fps
        Least rate of frames over the last second [1/s].
    max_shift_mm, max_turn_deg
        Greatest shift along the couch and rotation of the markers since the reference was set; also the greatest tilt
        and roll of the region's surface.
    max_marker_travel_mm
        Greatest travel of the markers along the couch within ten seconds, for windows on a part of the region: stickers
        on clothing slide over the skin. On skin the mean of chest and abdomen travels by 3 to 5 mm.
    max_height_mm
        Greatest rigid change of the surface's height since the reference was set; breathing is taken off.
    max_baseline_drift_mm
        Greatest distance of the end of exhale from where it was at the reference, for amplitude windows; for a window
        on the volume, 0.1 l per mm. Half the window and a third of a breath also bound it.
    warn_latency_ms, max_latency_ms
        From capture to the command of the line: warning, and fault (AAPM TG-142: gating within 100 ms; TG-76: 500 ms
        in all).
    camera_latency_ms
        Delay inside the camera, as measured by the site; part of the latency.
    max_model_age_min
        Longest use of a model after it was trained or compared with the patient.
    max_unwritten_ms
        Longest time that a sample or transition of an armed gate may wait to be stored; a kill loses no more than this.
    max_service_silence_ms
        Longest silence of the service process while armed, where it is not the engine's own: no hold by hand would
        arrive, and nothing would be stored.
    operator_timeout_s
        Longest silence of the page of the person who armed or released a hold since; where a program armed, of the
        pages of all persons who may arm. 0 switches this check off. A page reports every second: ten reports may be
        lost, as by a page that is loaded again, and about two breaths pass unseen.
    is_calibrated
        Whether the camera's geometry was measured; otherwise the beam is held.
    max_baseline_correction_mm
        Greatest total baseline correction of the window; for a window on the volume, the volume of the region over
        this distance.
    max_reference_distance_mm
        Greatest distance of the reference, and of the window with its corrections, from the first reference of the
        fraction; for a window on the volume, 0.1 l per mm. Beyond it a person who may arm has to give a reason.
    max_position_shift_mm, max_position_turn_deg, max_position_shape_mm
        Greatest shift along each axis, turn about each, and remaining difference of shape between the patient's surface
        and that of the plan's position. Beyond them a person who may arm has to give a reason.
    window_lower_mm, window_upper_mm
        Bounds of the window's edges, after conversion and correction; arming is refused beyond them.
    min_breaths_per_min, max_breaths_per_min
        Rate of the gated breathing within which the beam may be on; where the rate is known well enough, and no breath
        is held. Makers of accelerators ask for 1 to 30.
    holding_events
        Breathing events that hold the beam. While a breath is held in a window for it, only those hold that no breath
        hold resembles (`EVENTS_OF_A_BREATH_HOLD`).
    warm_up_s, cold_share
        How long a cold camera of this kind has to run before the beam may be on [s], 0 for a recording; and how cold
        this one is when the session begins, as in :class:`engine.core.warmth.Warmth`.
    head_direction
        The side of the picture at which the patient's head lies; None if it is unknown: then only the whole region and
        its volume may gate.
    needs_countersignature
        Whether a second person countersigns reference and window before the first arming of a fraction, and another
        window for a patient needs a reason.
    needs_all_checks
        Whether the beam is held where a check of the measurement has not worked since the reference was set; one that
        worked and cannot any more always holds.
    breath_depths
        Depth of the learned breath in each signal of the window, which distinguishes a breath from a drift.
        The loop sets this from the model in use.
    is_played
        Whether the frames come from a recording. A player may fall behind, so its lag does not indicate the age of a
        frame. The loop sets this from the description of the source.
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
    min_signal_share: float = 0.7
    min_wide_share: float = 0.9
    max_residual_mm: float = 3.0
    max_jump_mm: float = 4.0
    min_on_ms: float = 0.0
    min_off_ms: float = 0.0
    max_cycles_per_min: int = 120
    max_beam_on_s: float = 30.0
    max_duty_percent: float = 90.0
    max_clock_jump_ms: float = 250.0
    min_fps: float = 20.0
    max_shift_mm: float = 6.0
    max_turn_deg: float = 3.0
    max_marker_travel_mm: float = 6.0
    max_height_mm: float = 3.0
    max_baseline_drift_mm: float = 2.0
    warn_latency_ms: float = 100.0
    max_latency_ms: float = 500.0
    camera_latency_ms: float = 0.0
    max_model_age_min: float = 240.0
    max_unwritten_ms: float = 1_000.0
    max_service_silence_ms: float = 500.0
    operator_timeout_s: float = 10.0
    max_baseline_correction_mm: float = 5.0
    max_reference_distance_mm: float = 2.0
    max_position_shift_mm: float = 2.0
    max_position_turn_deg: float = 1.0
    max_position_shape_mm: float = 2.0
    window_lower_mm: float = -100.0
    window_upper_mm: float = 100.0
    is_calibrated: bool = True
    warm_up_s: float = 0.0
    cold_share: float = 1.0
    head_direction: HeadDirection | None = None
    min_breaths_per_min: float = 1.0
    max_breaths_per_min: float = 30.0
    holding_events: frozenset[BreathEventKind] = BREATHING_CEASED
    needs_all_checks: bool = False
    needs_countersignature: bool = False
    breath_depths: tuple[BreathDepth, ...] = ()
    is_played: bool = False

    def __post_init__(self) -> None:
        """Raise InvalidValueError for a number out of its bounds, or limits that contradict each other."""
        check_numbers(self, LIMIT_BOUNDS)
        check_number("warm_up_s", self.warm_up_s, *WARM_UP_BOUNDS_S)
        check_number("cold_share", self.cold_share, 0.0, 1.0)
        for name in WHOLE_NUMBERS:
            if not isinstance(getattr(self, name), int):
                raise InvalidValueError(name, getattr(self, name), "a whole number")
        if self.max_latency_ms < self.warn_latency_ms:
            bound = f"at least warn_latency_ms ({self.warn_latency_ms:g})"
            raise InvalidValueError("max_latency_ms", self.max_latency_ms, bound)
        if self.max_silence_ms < self.max_gap_ms:
            bound = f"at least max_gap_ms ({self.max_gap_ms:g})"
            raise InvalidValueError("max_silence_ms", self.max_silence_ms, bound)

    @cached_property
    def lease_ns(self) -> int:
        """The lease of the line [ns]."""
        return ns_from_ms(self.lease_ms)

    @cached_property
    def dwell_ns(self) -> int:
        """The dwell [ns]."""
        return ns_from_ms(self.dwell_ms)

    @cached_property
    def dwell_ns_after_cut_short(self) -> int:
        """The dwell after a beam on that was shorter than the shortest [ns]."""
        return ns_from_ms(self.dwell_ms + self.min_on_ms)

    @cached_property
    def has_breath_hold(self) -> bool:
        """Whether a condition of the window is a breath hold."""
        return True in [isinstance(leaf, BreathHoldWindow) for leaf in self.window.leaves]

    @cached_property
    def judged_events(self) -> frozenset[BreathEventKind]:
        """The breathing events that hold the beam in every frame; in a held breath no others do (`is_held`)."""
        return self.holding_events - EVENTS_OF_A_BREATH_HOLD if self.has_breath_hold else self.holding_events

    @cached_property
    def needs_head_direction(self) -> bool:
        """Whether the window is on a part of the patient, not only on the whole region or its volume."""
        return True in [depends_on_head(choice) for choice in self.window.choices]


def ns_from_ms(duration_ms: float) -> int:
    """Convert to whole nanoseconds, rounded down."""
    return int(duration_ms * NS_PER_MS)
