"""Names of the settings: where each stands in the site's file, and which an environment variable overrides."""

PREFIX = "TIDEGATE_"
CONFIG = f"{PREFIX}CONFIG"
"""The variable that names the site's file (TOML)."""

_SECTIONS: dict[str, tuple[str, ...]] = {
    "site": (
        "site_name",
        "machine_name",
        "room",
        "mode",
        "camera_uri",
        "gantry_side",
        "recordings_dirs",
        "recordings_may_gate",
        "frame_path",
        "log_format",
        "log_level",
    ),
    "web": (
        "host",
        "port",
        "tls_cert",
        "tls_key",
        "behind_proxy",
        "trusted_proxies",
        "allowed_hosts",
        "allowed_origins",
        "certificate_warn_days",
        "readiness_keep_ms",
        "max_body_bytes",
        "max_live_clients",
        "live_stall_s",
        "live_resume_s",
        "idempotency_days",
        "command_timeout_s",
    ),
    "access": ("login_hours", "login_idle_min", "key_max_days"),
    "storage": (
        "data_dir",
        "database_url",
        "database_password_file",
        "journal_dir",
        "sample_batch_ms",
        "min_free_disk_mb",
        "retain_samples_days",
        "retain_raw_days",
        "data_quota_gb",
        "session_room_min",
        "record_raw",
        "raw_min_free_mb",
    ),
    "plans": ("max_plan_bytes", "plan_patient", "plan_patient_key"),
    "beam": ("hardware_dead_man",),
    "camera": ("warm_up_min", "keep_warm_min", "depth_preset", "depth_exposure_us", "laser_percent"),
    "gate": ("beam_without_calibration",),
    "training": ("retrain_interval_min",),
}
_PREFIXES = {
    "oidc_": "oidc",
    "http_": "http",
    "audit_": "audit",
    "qa_": "qa",
    "beam_": "beam",
    "training_": "training",
    "likeness_": "match",
}
"""The beginning of a setting's name says its section, and is left out there."""
_SECTION_OF = {name: section for section, names in _SECTIONS.items() for name in names}

OVERRIDES = frozenset(
    {
        "allowed_hosts",
        "allowed_origins",
        "audit_anchor_file",
        "audit_log_dir",
        "beam_line",
        "beam_line_2",
        "beam_modbus_host",
        "beam_modbus_port",
        "beam_notify_http",
        "beam_notify_udp",
        "beam_on_input",
        "beam_relay_device",
        "beam_rtu_baud",
        "beam_rtu_device",
        "beam_second_input",
        "beam_second_input_2",
        "behind_proxy",
        "camera_latency_ms",
        "camera_uri",
        "checks_may_be_missing",
        "data_dir",
        "database_password_file",
        "database_url",
        "frame_path",
        "gantry_side",
        "hardware_dead_man",
        "holding_events",
        "host",
        "journal_dir",
        "lease_ms",
        "log_format",
        "log_level",
        "machine_name",
        "max_frame_age_ms",
        "max_gap_ms",
        "max_lag_ms",
        "max_latency_ms",
        "max_live_clients",
        "max_silence_ms",
        "min_free_disk_mb",
        "mode",
        "oidc_ca_file",
        "oidc_client_id",
        "oidc_client_secret_file",
        "oidc_issuer",
        "oidc_redirect_uri",
        "operator_timeout_s",
        "plan_patient_key",
        "port",
        "qa_required_daily_h",
        "record_raw",
        "recordings_dirs",
        "recordings_may_gate",
        "room",
        "site_name",
        "tls_cert",
        "tls_key",
        "trusted_proxies",
        "watchdog_ms",
    }
)
"""Settings that the environment may override: what differs between machines, and the times of the supervision."""


def place_of(name: str) -> tuple[str, str]:
    """Return a setting's section in the file and its key there."""
    if name in _SECTION_OF:
        return _SECTION_OF[name], name
    for prefix, section in _PREFIXES.items():
        if name.startswith(prefix):
            return section, name.removeprefix(prefix)
    return "gate", name


def setting_name(name: str) -> str:
    """Return the name that people know: the environment variable, or section and key in the file."""
    return f"{PREFIX}{name.upper()}" if name in OVERRIDES else ".".join(place_of(name))
