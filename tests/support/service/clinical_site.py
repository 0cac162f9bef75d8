"""Settings of a site that may start in clinical mode: what is obligatory, and nothing more."""

from typing import Any

from service.core.settings.settings import Settings

OBLIGATORY: dict[str, Any] = {
    "beam_without_calibration": False,
    "checks_may_be_missing": False,
    "allow_device_registration": False,
    "camera_latency_ms": 40.0,
    "qa_required_daily_h": 24.0,
    "min_dwell_ms": 100.0,
    "min_off_ms": 1_000.0,
    "max_cycles_per_min": 30,
    "window_lower_mm": -5.0,
    "window_upper_mm": 30.0,
    "max_shift_mm": 4.0,
    "max_turn_deg": 2.0,
    "max_baseline_correction_mm": 3.0,
    "max_breath_hold_s": 40.0,
    "likeness_max_shift_mm": 10.0,
    "likeness_max_tilt_deg": 3.0,
}
"""What the defaults lack, except for the beam line."""
LINE: dict[str, Any] = {"beam_line": "modbus-tcp", "beam_modbus_host": "127.0.0.1", "hardware_dead_man": True}
CLINICAL: dict[str, Any] = {"mode": "clinical", **OBLIGATORY, **LINE}


def clinical_settings(**changes: Any) -> Settings:
    """Return a clinical site's settings, with some changed."""
    return Settings(**CLINICAL | changes)


def environment(values: dict[str, Any]) -> dict[str, str]:
    """Return settings as environment variables without the prefix."""
    return {
        name.upper(): str(value).lower() if isinstance(value, bool) else str(value) for name, value in values.items()
    }
