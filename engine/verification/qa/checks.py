"""The table of QA checks: method, kinds of run, and bounds with their source.

Bounds follow the field's recommendations where they exist: AAPM TG-142 (gating within 100 ms, localisation within
2 mm, 1 mm for stereotactic treatments), TG-147 and TG-302 (localisation and surface imaging, the same two classes),
TG-76 (gated and breath-hold treatments). Gating serves breath holds and stereotactic fractions, so a deviation of 1 mm
fails; a true error of 2 mm is then well beyond the bound. Where no recommendation exists, the bound follows from what
the system tolerates, and ``source`` names it.
"""

from collections.abc import Mapping
from types import MappingProxyType

from engine.beam.heartbeat_drill import MARGIN_MS
from engine.beam.second_input import RECEIVER_DROP_MS
from engine.core.errors import InvalidValueError
from engine.verification.qa.results import QaCheck, QaKind, QaNeed, Sidedness

DAILY = (QaKind.DAILY, QaKind.MONTHLY, QaKind.ANNUAL)
MONTHLY = (QaKind.MONTHLY, QaKind.ANNUAL)
ANNUAL = (QaKind.ANNUAL,)

_LOCALISATION = "TG-142, TG-147, TG-302: 2 mm, and 1 mm for stereotactic treatments"
_TIMING = "TG-142: gate within 100 ms of expected"
_TILT = "1 degree shifts a point 60 mm from the set-up point by 1 mm"
_LINE = "docs/3-operate/beam.md: a failing line is latched within 200 ms; TG-142: 100 ms for the whole gate"
_OFF = "TG-142: interlock functional; off within the 100 ms allowed for the whole gate"
_RECORDED = " A live camera's transport delay is included; a recording holds no arrival times."

_PLATE = (
    QaCheck(
        code="camera_distance_mm",
        title="Camera distance",
        unit="mm",
        method="Distance along the optical axis to the plane fitted to the mean of all frames; against the baseline.",
        needs=QaNeed.PLATE,
        kinds=DAILY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.7,
        fail=1.0,
        most=5.0,
        source=_LOCALISATION,
        has_baseline=True,
    ),
    QaCheck(
        code="camera_tilt_x_deg",
        title="Camera angle across the couch",
        unit="deg",
        method="Angle of the plate's normal to the optical axis along the picture's rows; against the baseline.",
        needs=QaNeed.PLATE,
        kinds=DAILY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.5,
        fail=1.0,
        most=5.0,
        source=_TILT,
        has_baseline=True,
    ),
    QaCheck(
        code="camera_tilt_y_deg",
        title="Camera angle along the couch",
        unit="deg",
        method="Angle of the plate's normal to the optical axis along the picture's columns; against the baseline.",
        needs=QaNeed.PLATE,
        kinds=DAILY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.5,
        fail=1.0,
        most=5.0,
        source=_TILT,
        has_baseline=True,
    ),
    QaCheck(
        code="plate_noise_mm",
        title="Noise of a pixel",
        unit="mm",
        method="Standard deviation of a pixel from frame to frame, the median over the plate.",
        needs=QaNeed.PLATE,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=2.0,
        fail=3.0,
        most=6.0,
        source="The mean of a region of 25 x 25 px reduces 3 mm to less than a tenth of the 2 mm of TG-302",
    ),
    QaCheck(
        code="plate_missing_percent",
        title="Pixels without a reading",
        unit="%",
        method="Share of the plate's pixels without a reading, over all frames.",
        needs=QaNeed.PLATE,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=10.0,
        fail=20.0,
        most=50.0,
        source="The gate holds when more than 20 % of the region has no reading",
    ),
    QaCheck(
        code="plate_drift_mm",
        title="Drift over the recording",
        unit="mm",
        method="Slope of a straight line through the plate's mean in each second, times the recording's length.",
        needs=QaNeed.PLATE,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.5,
        fail=1.0,
        most=5.0,
        source=_LOCALISATION,
        expected=0.0,
    ),
    QaCheck(
        code="plate_flatness_mm",
        title="Flatness",
        unit="mm",
        method="Root mean square of the plate's deviation from a plane, in patches a twelfth of the part's side.",
        needs=QaNeed.PLATE,
        kinds=MONTHLY,
        sidedness=Sidedness.AT_MOST,
        warn=1.0,
        fail=2.0,
        most=5.0,
        source=_LOCALISATION,
    ),
    QaCheck(
        code="warm_up_drift_mm_per_min",
        title="Warm-up",
        unit="mm/min",
        method="Slope of a straight line through the plate's mean in each second of the recording's last 30 seconds.",
        needs=QaNeed.PLATE,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.07,
        fail=0.15,
        most=1.0,
        source="TG-147, TG-302: let a camera warm up; 0.07 mm/min are 1 mm over a fraction of 15 min",
        expected=0.0,
    ),
)

_PHANTOM = (
    QaCheck(
        code="motion_offset_mm",
        title="Motion offset",
        unit="mm",
        method="Mean of measured less commanded motion, both from the same reference, the lag removed.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.5,
        fail=1.0,
        most=2.0,
        source=_LOCALISATION,
        expected=0.0,
    ),
    QaCheck(
        code="motion_error_mm",
        title="Motion error, mean",
        unit="mm",
        method="Mean absolute difference of measured and commanded motion, from the same reference, the lag removed.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.AT_MOST,
        warn=0.5,
        fail=1.0,
        most=2.0,
        source=_LOCALISATION,
    ),
    QaCheck(
        code="motion_error_p95_mm",
        title="Motion error, 95th percentile",
        unit="mm",
        method="95th percentile of the absolute difference of measured and commanded motion, the lag removed.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.AT_MOST,
        warn=1.0,
        fail=1.5,
        most=3.0,
        source=_LOCALISATION,
    ),
    QaCheck(
        code="motion_amplitude_ratio",
        title="Amplitude, measured to commanded",
        unit="",
        method="Slope of the line fitted to measured against commanded motion, the lag removed.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=0.05,
        fail=0.1,
        most=0.2,
        source="A tenth of a breath of 10 mm is the 1 mm of TG-302",
        expected=1.0,
    ),
    QaCheck(
        code="motion_lag_ms",
        title="Lag of the measured motion",
        unit="ms",
        method="Delay at which measured and commanded motion correlate best; includes the camera's delay.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=70.0,
        fail=100.0,
        most=500.0,
        source="TG-142: surrogate within 100 ms of expected",
        expected=0.0,
    ),
    QaCheck(
        code="motion_lost_percent",
        title="Frames that could not be measured",
        unit="%",
        method="Share of the frames after the first measured one without a motion.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.AT_MOST,
        warn=1.0,
        fail=5.0,
        most=20.0,
        source="Each lost frame holds the beam for a dwell; 5 % is the system's own bound",
    ),
    QaCheck(
        code="gate_mean_delay_ms",
        title="Gate delay, mean of on and off",
        unit="ms",
        method="Delay of the middle of a beam-on interval after the sine's turning point, less half the dwell."
        + _RECORDED,
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=80.0,
        fail=100.0,
        most=500.0,
        source=_TIMING,
        expected=0.0,
    ),
    QaCheck(
        code="gate_delay_difference_ms",
        title="Gate delay, off less on",
        unit="ms",
        method="Intercept of the line through the intervals' lengths against the sine's periods, plus the dwell."
        + _RECORDED,
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=80.0,
        fail=100.0,
        most=500.0,
        source=_TIMING,
        expected=0.0,
    ),
    QaCheck(
        code="gate_delay_on_ms",
        title="Gate delay, on",
        unit="ms",
        method="Mean delay less half the difference: from the sine entering the window, plus the dwell, to beam on."
        + _RECORDED,
        needs=QaNeed.PHANTOM,
        kinds=ANNUAL,
        sidedness=Sidedness.ABSOLUTE,
        warn=80.0,
        fail=100.0,
        most=500.0,
        source=_TIMING,
        expected=0.0,
    ),
    QaCheck(
        code="gate_delay_off_ms",
        title="Gate delay, off",
        unit="ms",
        method="Mean delay plus half the difference: from the sine leaving the window to beam off." + _RECORDED,
        needs=QaNeed.PHANTOM,
        kinds=ANNUAL,
        sidedness=Sidedness.ABSOLUTE,
        warn=80.0,
        fail=100.0,
        most=500.0,
        source=_TIMING,
        expected=0.0,
    ),
    QaCheck(
        code="beam_off_total_ms",
        title="Beam off, from the phantom to the line",
        unit="ms",
        method="Gate delay off plus the 99th percentile of a hold's read-back." + _RECORDED,
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.AT_MOST,
        warn=100.0,
        fail=150.0,
        most=500.0,
        source="TG-142: 100 ms for the gate, and half as much for the line's worst case; TG-76: 500 ms in total",
    ),
    QaCheck(
        code="beam_outside_ms",
        title="Beam on outside of the window, longest",
        unit="ms",
        method="Beam-on time, dwell included, in each excursion of the commanded motion from the window; the longest."
        + _RECORDED,
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.AT_MOST,
        warn=100.0,
        fail=150.0,
        most=500.0,
        source="TG-142: gate within 100 ms of expected, in every cycle; 150 ms fails",
    ),
    QaCheck(
        code="duty_cycle_change_percent",
        title="Change of duty cycle",
        unit="%",
        method="Duty cycle of the beam over whole cycles, less that of the sine inside the window after a dwell.",
        needs=QaNeed.PHANTOM,
        kinds=MONTHLY,
        sidedness=Sidedness.ABSOLUTE,
        warn=1.5,
        fail=2.0,
        most=10.0,
        source="2 %, TG-142's tolerance for the output of a gated beam",
        expected=0.0,
    ),
)

_BEAM = (
    QaCheck(
        code="beam_readback_on_ms",
        title="Read-back of a permit",
        unit="ms",
        method="From a permit to the line read back on, 99th percentile.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=80.0,
        fail=100.0,
        most=200.0,
        source=_LINE,
    ),
    QaCheck(
        code="beam_readback_off_ms",
        title="Read-back of a hold",
        unit="ms",
        method="From a hold to the line read back off, 99th percentile.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=80.0,
        fail=100.0,
        most=200.0,
        source=_LINE,
    ),
    QaCheck(
        code="beam_readback_errors",
        title="Read-back errors",
        unit="",
        method="Number of permits and holds without the matching read-back, or without an answer.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=0.0,
        fail=0.0,
        most=0.0,
        source="TG-142: interlock functional",
    ),
    QaCheck(
        code="fail_safe_hold_ms",
        title="Drill: a hold",
        unit="ms",
        method="From a hold while the beam is on and its lease runs, to the line read back off; the slowest.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=80.0,
        fail=100.0,
        most=200.0,
        source=_OFF,
    ),
    QaCheck(
        code="fail_safe_lease_ms",
        title="Drill: a lease that is not renewed",
        unit="ms",
        method="From the end of a lease that is not renewed to the line read back off; the slowest.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=80.0,
        fail=100.0,
        most=200.0,
        source=_OFF,
    ),
    QaCheck(
        code="fail_safe_fault_ms",
        title="Drill: a fault",
        unit="ms",
        method="From a fault to the line read back off; the line must then refuse permits and stay off until armed.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=80.0,
        fail=100.0,
        most=200.0,
        source=_OFF,
    ),
    QaCheck(
        code="fail_safe_watchdog_ms",
        title="Drill: an engine that stops deciding",
        unit="ms",
        method="From the watchdog's deadline to the line read back off and latched, while its lease still runs.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=80.0,
        fail=100.0,
        most=200.0,
        source=_OFF,
    ),
    QaCheck(
        code="fail_safe_heartbeat_ms",
        title="Drill: a heartbeat that stands still",
        unit="ms",
        method="From the last heartbeat to the contact open, by a second input, as when this process is killed; it "
        "must stay open until the permit was withdrawn once.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=RECEIVER_DROP_MS + 0.6 * MARGIN_MS,
        fail=RECEIVER_DROP_MS + MARGIN_MS,
        most=RECEIVER_DROP_MS + MARGIN_MS,
        source="docs/3-operate/beam.md: a receiver drops the permit within 200 ms, and 50 ms for exchange and look",
    ),
    QaCheck(
        code="hold_to_beam_off_ms",
        title="Beam off, from a hold to the accelerator",
        unit="ms",
        method="From a hold to the accelerator's beam-on signal off, the slowest; only where the signal is an input, "
        "and the accelerator delivered during the drills.",
        needs=QaNeed.BEAM,
        kinds=DAILY,
        sidedness=Sidedness.AT_MOST,
        warn=100.0,
        fail=150.0,
        most=500.0,
        source="TG-142: 100 ms for the gate, and half as much for the line's worst case; TG-76: 500 ms in total",
        is_optional=True,
    ),
)

CHECKS: tuple[QaCheck, ...] = _PLATE + _PHANTOM + _BEAM
"""All checks, in the order of a report."""

_BY_CODE: Mapping[str, QaCheck] = MappingProxyType({check.code: check for check in CHECKS})


def check_of(code: str) -> QaCheck:
    """Return the check with this code; raise InvalidValueError if there is none."""
    if code not in _BY_CODE:
        raise InvalidValueError("check", code, f"one of {', '.join(_BY_CODE)}")
    return _BY_CODE[code]


def checks_of(kind: QaKind) -> tuple[QaCheck, ...]:
    """Return the checks of a kind of run, in the order of the report."""
    return tuple(check for check in CHECKS if kind in check.kinds)


def needs_of(kind: QaKind) -> tuple[QaNeed, ...]:
    """Return the inputs that a kind of run needs, in the order of its stages."""
    return tuple(need for need in QaNeed if any(check.needs is need for check in checks_of(kind)))
