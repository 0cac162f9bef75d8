"""The table of QA checks: method, kinds of run, and bounds with their source.

Bounds follow the field's recommendations where they exist: AAPM TG-142 (gating within 100 ms, localisation within
2 mm, 1 mm for stereotactic treatments), TG-147 and TG-302 (localisation and surface imaging, the same two classes),
TG-76 (gated and breath-hold treatments). Gating serves breath holds and stereotactic fractions, so a deviation of 1 mm
fails; a true error of 2 mm is then well beyond the bound. Where no recommendation exists, the bound follows from what
the system tolerates, and ``source`` names it.
"""

from collections.abc import Mapping
from types import MappingProxyType

from engine.beam.heartbeat_drill import MARGIN_MS, RECEIVER_DROP_MS
from engine.core.errors import InvalidValueError
from engine.qa.results import QaCheck, QaKind, QaNeed, Sidedness

DAILY = (QaKind.DAILY, QaKind.MONTHLY, QaKind.ANNUAL)
MONTHLY = (QaKind.MONTHLY, QaKind.ANNUAL)
ANNUAL = (QaKind.ANNUAL,)
LATENCY = (QaKind.LATENCY,)

_LOCALISATION = "TG-142, TG-147, TG-302: 2 mm, and 1 mm for stereotactic treatments"
_TIMING = "TG-142: gate within 100 ms of expected"
_TILT = "1 degree shifts a point 60 mm from the set-up point by 1 mm"
_LINE = "docs/3-operate/beam.md: a failing line is latched within 200 ms; TG-142: 100 ms for the whole gate"
_OFF = "TG-142: interlock functional; off within the 100 ms allowed for the whole gate"
_LATE = "TG-142: surrogate within 100 ms; TG-76: 500 ms in total"
_RECORDED = " A live camera's transport delay is included; a recording holds no arrival times."


def _check(
    name: tuple[str, str, str],
    bounds: tuple[QaNeed, tuple[QaKind, ...], Sidedness, float, float, float],
    method: str,
    source: str,
    *,
    expected: float | None = None,
    has_baseline: bool = False,
    is_optional: bool = False,
) -> QaCheck:
    """Return a check: code, title and unit; what it needs, kinds of run, side, and bounds (warn, fail, most)."""
    (code, title, unit), (needs, kinds, sidedness, warn, fail, most) = name, bounds
    return QaCheck(
        code=code,
        title=title,
        unit=unit,
        method=method,
        needs=needs,
        kinds=kinds,
        sidedness=sidedness,
        warn=warn,
        fail=fail,
        most=most,
        source=source,
        expected=expected,
        has_baseline=has_baseline,
        is_optional=is_optional,
    )


_PLATE = (
    _check(
        ("camera_distance_mm", "Camera distance", "mm"),
        (QaNeed.PLATE, DAILY, Sidedness.ABSOLUTE, 0.7, 1.0, 5.0),
        "Distance along the optical axis to the plane fitted to the mean of all frames; against the baseline.",
        _LOCALISATION,
        has_baseline=True,
    ),
    _check(
        ("camera_tilt_x_deg", "Camera angle across the couch", "deg"),
        (QaNeed.PLATE, DAILY, Sidedness.ABSOLUTE, 0.5, 1.0, 5.0),
        "Angle of the plate's normal to the optical axis along the picture's rows; against the baseline.",
        _TILT,
        has_baseline=True,
    ),
    _check(
        ("camera_tilt_y_deg", "Camera angle along the couch", "deg"),
        (QaNeed.PLATE, DAILY, Sidedness.ABSOLUTE, 0.5, 1.0, 5.0),
        "Angle of the plate's normal to the optical axis along the picture's columns; against the baseline.",
        _TILT,
        has_baseline=True,
    ),
    _check(
        ("plate_noise_mm", "Noise of a pixel", "mm"),
        (QaNeed.PLATE, DAILY, Sidedness.AT_MOST, 2.0, 3.0, 6.0),
        "Standard deviation of a pixel from frame to frame, the median over the plate.",
        "The mean of a region of 25 x 25 px reduces 3 mm to less than a tenth of the 2 mm of TG-302",
    ),
    _check(
        ("plate_missing_percent", "Pixels without a reading", "%"),
        (QaNeed.PLATE, DAILY, Sidedness.AT_MOST, 10.0, 20.0, 50.0),
        "Share of the plate's pixels without a reading, over all frames.",
        "The gate holds when more than 20 % of the region has no reading",
    ),
    _check(
        ("plate_drift_mm", "Drift over the recording", "mm"),
        (QaNeed.PLATE, MONTHLY, Sidedness.ABSOLUTE, 0.5, 1.0, 5.0),
        "Slope of a straight line through the plate's mean in each second, times the recording's length.",
        _LOCALISATION,
        expected=0.0,
    ),
    _check(
        ("plate_flatness_mm", "Flatness", "mm"),
        (QaNeed.PLATE, MONTHLY, Sidedness.AT_MOST, 1.0, 2.0, 5.0),
        "Root mean square of the plate's deviation from a plane, in patches a twelfth of the part's side.",
        _LOCALISATION,
    ),
    _check(
        ("warm_up_drift_mm_per_min", "Warm-up", "mm/min"),
        (QaNeed.PLATE, MONTHLY, Sidedness.ABSOLUTE, 0.07, 0.15, 1.0),
        "Slope of a straight line through the plate's mean in each second of the recording's last 30 seconds.",
        "TG-147, TG-302: let a camera warm up; 0.07 mm/min are 1 mm over a fraction of 15 min",
        expected=0.0,
    ),
)

_PHANTOM = (
    _check(
        ("motion_offset_mm", "Motion offset", "mm"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.ABSOLUTE, 0.5, 1.0, 2.0),
        "Mean of measured less commanded motion, both from the same reference, the lag removed.",
        _LOCALISATION,
        expected=0.0,
    ),
    _check(
        ("motion_error_mm", "Motion error, mean", "mm"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.AT_MOST, 0.5, 1.0, 2.0),
        "Mean absolute difference of measured and commanded motion, from the same reference, the lag removed.",
        _LOCALISATION,
    ),
    _check(
        ("motion_error_p95_mm", "Motion error, 95th percentile", "mm"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.AT_MOST, 1.0, 1.5, 3.0),
        "95th percentile of the absolute difference of measured and commanded motion, the lag removed.",
        _LOCALISATION,
    ),
    _check(
        ("motion_amplitude_ratio", "Amplitude, measured to commanded", ""),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.ABSOLUTE, 0.05, 0.1, 0.2),
        "Slope of the line fitted to measured against commanded motion, the lag removed.",
        "A tenth of a breath of 10 mm is the 1 mm of TG-302",
        expected=1.0,
    ),
    _check(
        ("motion_lag_ms", "Lag of the measured motion", "ms"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.ABSOLUTE, 70.0, 100.0, 500.0),
        "Delay at which measured and commanded motion correlate best; includes the camera's delay.",
        "TG-142: surrogate within 100 ms of expected",
        expected=0.0,
    ),
    _check(
        ("motion_lost_percent", "Frames that could not be measured", "%"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.AT_MOST, 1.0, 5.0, 20.0),
        "Share of the frames after the first measured one without a motion.",
        "Each lost frame holds the beam for a dwell; 5 % is the system's own bound",
    ),
    _check(
        ("gate_mean_delay_ms", "Gate delay, mean of on and off", "ms"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.ABSOLUTE, 80.0, 100.0, 500.0),
        "Delay of the middle of a beam-on interval after the sine's turning point, less half the dwell." + _RECORDED,
        _TIMING,
        expected=0.0,
    ),
    _check(
        ("gate_delay_difference_ms", "Gate delay, off less on", "ms"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.ABSOLUTE, 80.0, 100.0, 500.0),
        "Intercept of the line through the intervals' lengths against the sine's periods, plus the dwell." + _RECORDED,
        _TIMING,
        expected=0.0,
    ),
    _check(
        ("gate_delay_on_ms", "Gate delay, on", "ms"),
        (QaNeed.PHANTOM, ANNUAL, Sidedness.ABSOLUTE, 80.0, 100.0, 500.0),
        "Mean delay less half the difference: from the sine entering the window, plus the dwell, to beam on."
        + _RECORDED,
        _TIMING,
        expected=0.0,
    ),
    _check(
        ("gate_delay_off_ms", "Gate delay, off", "ms"),
        (QaNeed.PHANTOM, ANNUAL, Sidedness.ABSOLUTE, 80.0, 100.0, 500.0),
        "Mean delay plus half the difference: from the sine leaving the window to beam off." + _RECORDED,
        _TIMING,
        expected=0.0,
    ),
    _check(
        ("beam_off_total_ms", "Beam off, from the phantom to the line", "ms"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.AT_MOST, 100.0, 150.0, 500.0),
        "Gate delay off plus the 99th percentile of a hold's read-back." + _RECORDED,
        "TG-142: 100 ms for the gate, and half as much for the line's worst case; TG-76: 500 ms in total",
    ),
    _check(
        ("beam_outside_ms", "Beam on outside of the window, longest", "ms"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.AT_MOST, 100.0, 150.0, 500.0),
        "Beam-on time, dwell included, in each excursion of the commanded motion from the window; the longest."
        + _RECORDED,
        "TG-142: gate within 100 ms of expected, in every cycle; 150 ms fails",
    ),
    _check(
        ("duty_cycle_change_percent", "Change of duty cycle", "%"),
        (QaNeed.PHANTOM, MONTHLY, Sidedness.ABSOLUTE, 1.5, 2.0, 10.0),
        "Duty cycle of the beam over whole cycles, less that of the sine inside the window after a dwell.",
        "2 %, TG-142's tolerance for the output of a gated beam",
        expected=0.0,
    ),
)

_BEAM = (
    _check(
        ("beam_readback_on_ms", "Read-back of a permit", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 80.0, 100.0, 200.0),
        "From a permit to the line read back on, 99th percentile.",
        _LINE,
    ),
    _check(
        ("beam_readback_off_ms", "Read-back of a hold", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 80.0, 100.0, 200.0),
        "From a hold to the line read back off, 99th percentile.",
        _LINE,
    ),
    _check(
        ("beam_readback_errors", "Read-back errors", ""),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 0.0, 0.0, 0.0),
        "Number of permits and holds without the matching read-back, or without an answer.",
        "TG-142: interlock functional",
    ),
    _check(
        ("fail_safe_hold_ms", "Drill: a hold", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 80.0, 100.0, 200.0),
        "From a hold while the beam is on and its lease runs, to the line read back off; the slowest.",
        _OFF,
    ),
    _check(
        ("fail_safe_lease_ms", "Drill: a lease that is not renewed", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 80.0, 100.0, 200.0),
        "From the end of a lease that is not renewed to the line read back off; the slowest.",
        _OFF,
    ),
    _check(
        ("fail_safe_fault_ms", "Drill: a fault", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 80.0, 100.0, 200.0),
        "From a fault to the line read back off; the line must then refuse permits and stay off until armed.",
        _OFF,
    ),
    _check(
        ("fail_safe_watchdog_ms", "Drill: an engine that stops deciding", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 80.0, 100.0, 200.0),
        "From the watchdog's deadline to the line read back off and latched, while its lease still runs.",
        _OFF,
    ),
    _check(
        ("fail_safe_heartbeat_ms", "Drill: a heartbeat that stands still", "ms"),
        (
            QaNeed.BEAM,
            DAILY,
            Sidedness.AT_MOST,
            RECEIVER_DROP_MS + 0.6 * MARGIN_MS,
            RECEIVER_DROP_MS + MARGIN_MS,
            RECEIVER_DROP_MS + MARGIN_MS,
        ),
        "From the last heartbeat to the contact open, by a second input, as when this process is killed; it "
        "must stay open until the permit was withdrawn once.",
        "docs/3-operate/beam.md: a receiver drops the permit within 200 ms, and 50 ms for exchange and look",
    ),
    _check(
        ("hold_to_beam_off_ms", "Beam off after a hold", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 100.0, 150.0, 500.0),
        "From a hold to the accelerator's beam-on signal off, the slowest; only where the signal is an input, "
        "and the accelerator delivered during the drills.",
        "TG-142: 100 ms for the gate, and half as much for the line's worst case; TG-76: 500 ms in total",
        is_optional=True,
    ),
    _check(
        ("treatment_beam_off_ms", "Beam off in treatments", "ms"),
        (QaNeed.BEAM, DAILY, Sidedness.AT_MOST, 100.0, 150.0, 500.0),
        "From each end of a permit to the accelerator's beam-on signal off, in the sessions since the last "
        "finished run; 95th percentile. Only where the signal is an input, and a beam was held.",
        "TG-142: 100 ms for the gate, and half as much for the line's worst case; TG-76: 500 ms in total",
        is_optional=True,
    ),
)

_CAMERA = (
    _check(
        ("camera_latency_ms", "Camera latency, median", "ms"),
        (QaNeed.CAMERA, LATENCY, Sidedness.AT_MOST, 100.0, 150.0, 250.0),
        "From a change of light, or a position of a plate, to the receipt of the depth frame; median of all "
        "frames. With its uncertainty it is the delay that the gate counts for the camera.",
        _LATE,
    ),
    _check(
        ("camera_latency_p95_ms", "Camera latency, 95th percentile", "ms"),
        (QaNeed.CAMERA, LATENCY, Sidedness.AT_MOST, 120.0, 180.0, 300.0),
        "The same, 95th percentile.",
        _LATE,
    ),
    _check(
        ("camera_latency_worst_ms", "Camera latency, slowest frame", "ms"),
        (QaNeed.CAMERA, LATENCY, Sidedness.AT_MOST, 200.0, 350.0, 500.0),
        "The same, slowest frame.",
        _LATE,
    ),
    _check(
        ("camera_latency_uncertainty_ms", "Camera latency, uncertainty", "ms"),
        (QaNeed.CAMERA, LATENCY, Sidedness.AT_MOST, 15.0, 25.0, 25.0),
        "Half the width of the interval of latencies that nine tenths of the changes of the light permit; of a "
        "plate, three standard errors and the bound of its clock.",
        "A quarter of the 100 ms of TG-142",
    ),
)

CHECKS: tuple[QaCheck, ...] = _PLATE + _PHANTOM + _BEAM + _CAMERA
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
