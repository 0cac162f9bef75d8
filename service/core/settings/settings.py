"""The site's settings: the file that ``TIDEGATE_CONFIG`` names, and some variables ``TIDEGATE_*`` that override it.

Read once at start, frozen, every number bounded.

A session may narrow the site's limits, never widen them.
"""

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, InitSettingsSource, NoDecode, PydanticBaseSettingsSource, SettingsConfigDict

from engine.core.breath import BreathEventKind
from engine.core.errors import InvalidValueError
from engine.gating import BREATHING_CEASED, HOLD_BOUNDS, LIMIT_BOUNDS, GateLimits, amplitude_window
from engine.motion import (
    MARKER_PLACEMENT_BOUNDS,
    MARKER_PLACEMENT_MM,
    PATIENT_MATCH_BOUNDS,
    TRAINING_BOUNDS,
    PatientMatchLimits,
    TrainingSettings,
)
from service.core.settings.access import AccessSettings
from service.core.settings.beam import BeamSettings
from service.core.settings.clinical import refusals
from service.core.settings.config_file import SettingsError, config_path, read_config, unknown_variables
from service.core.settings.groups import (
    AuditSettings,
    CameraSettings,
    DatabaseSettings,
    ExchangeSettings,
    MonitoringSettings,
    PlanSettings,
    ReplaySettings,
    RoomSettings,
    StorageSettings,
    StreamSettings,
)
from service.core.settings.names import OVERRIDES, PREFIX, Env, Section, setting_name
from service.core.settings.oidc import OidcSettings
from service.core.settings.qa import CHOSEN, QaSettings

__all__ = ["Settings", "SettingsError", "load_settings", "sources"]

SETTING_OF = {"retrain_interval_s": "retrain_interval_min"}
"""Settings of the training with another name and unit here."""

SHORTEST_OPERATOR_TIMEOUT_S = 3.0
"""A page reports presence every second; this allows for two reports that are late."""

LIMIT_DEFAULTS = {field.name: field.default for field in dataclasses.fields(GateLimits)}
EventList = Annotated[tuple[BreathEventKind, ...], NoDecode]


def _limit(name: str) -> Any:  # noqa: ANN401 - a field of any number's type
    """Declare a gate limit with the engine's default and bounds."""
    low, high = LIMIT_BOUNDS[name]
    return Field(default=LIMIT_DEFAULTS[name], ge=low, le=high)


def _training(name: str, most: float | None = None) -> Any:  # noqa: ANN401 - a field of any number's type
    """Declare a setting of the training with the engine's default and bounds; ``most`` narrows them."""
    low, high = TRAINING_BOUNDS[name]
    return Field(default=getattr(TrainingSettings(), name), ge=low, le=high if most is None else most)


def _likeness(name: str) -> Any:  # noqa: ANN401 - a field of any number's type
    """Declare a limit of the patient match with the engine's default and bounds."""
    low, high = PATIENT_MATCH_BOUNDS[name]
    return Field(default=getattr(PatientMatchLimits(), name), ge=low, le=high)


class TrainingGroup(Section):
    """How a motion model is learned."""

    SECTION = "training"
    KEY_PREFIX = "training_"

    training_min_frames: int = _training("min_frames", most=TrainingSettings().max_frames // 2)
    training_min_cycles: int = _training("min_cycles")
    training_min_seconds: float = _training("min_seconds")
    training_max_seconds: float = _training("max_seconds")
    retrain_interval_min: float = Field(
        default=0.0, ge=0.0, le=240.0, description="Interval of learning a new model during a session; 0 is never"
    )


class MatchGroup(Section):
    """How a stored model is compared with the patient."""

    SECTION = "match"
    KEY_PREFIX = "likeness_"

    likeness_max_shift_mm: float = _likeness("max_shift_mm")
    likeness_max_tilt_deg: float = _likeness("max_tilt_deg")
    likeness_max_shape_mm: float = _likeness("max_shape_mm")
    likeness_max_residual_mm: float = _likeness("max_residual_mm")


class Settings(
    BeamSettings,
    QaSettings,
    AuditSettings,
    DatabaseSettings,
    AccessSettings,
    StorageSettings,
    ExchangeSettings,
    OidcSettings,
    ReplaySettings,
    StreamSettings,
    PlanSettings,
    MonitoringSettings,
    RoomSettings,
    CameraSettings,
    TrainingGroup,
    MatchGroup,
):
    """The site's settings."""

    SECTION, KEY_PREFIX = "gate", ""

    model_config = SettingsConfigDict(
        env_prefix=PREFIX, extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Return the sources that exist, the first counts most: no ``.env`` file and no folder of secrets."""
        path = config_path()
        if path is None:
            return init_settings, env_settings
        given = read_config(path, {name: field.annotation for name, field in cls.model_fields.items()})
        return init_settings, env_settings, InitSettingsSource(settings_cls, given)

    allow_device_registration: bool = Field(
        default=True, description="Sessions without a calibration use the camera's own registration: research only"
    )

    min_dwell_ms: float = Field(default=0.0, ge=0.0, le=10_000.0, description="Shortest dwell of a session")
    min_good_frames: int = _limit("min_good_frames")
    lease_ms: Env[float] = _limit("lease_ms")
    max_frame_age_ms: Env[float] = _limit("max_frame_age_ms")
    max_gap_ms: Env[float] = _limit("max_gap_ms")
    max_lag_ms: Env[float] = _limit("max_lag_ms")
    max_silence_ms: Env[float] = _limit("max_silence_ms")
    watchdog_ms: Env[float] = _limit("watchdog_ms")
    min_valid_share: float = _limit("min_valid_share")
    min_inlier_share: float = _limit("min_inlier_share")
    min_signal_share: float = _limit("min_signal_share")
    min_wide_share: float = _limit("min_wide_share")
    max_residual_mm: float = _limit("max_residual_mm")
    max_jump_mm: float = _limit("max_jump_mm")
    min_on_ms: float = _limit("min_on_ms")
    min_off_ms: float = _limit("min_off_ms")
    max_cycles_per_min: int = _limit("max_cycles_per_min")
    max_beam_on_s: float = _limit("max_beam_on_s")
    max_duty_percent: float = _limit("max_duty_percent")
    max_clock_jump_ms: float = _limit("max_clock_jump_ms")
    min_fps: float = _limit("min_fps")
    max_shift_mm: float = _limit("max_shift_mm")
    max_turn_deg: float = _limit("max_turn_deg")
    max_marker_travel_mm: float = _limit("max_marker_travel_mm")
    max_height_mm: float = _limit("max_height_mm")
    max_baseline_drift_mm: float = _limit("max_baseline_drift_mm")
    max_reference_distance_mm: float = _limit("max_reference_distance_mm")
    max_position_shift_mm: float = _limit("max_position_shift_mm")
    max_position_turn_deg: float = _limit("max_position_turn_deg")
    max_position_shape_mm: float = _limit("max_position_shape_mm")
    marker_placement_mm: float = Field(
        default=MARKER_PLACEMENT_MM,
        ge=MARKER_PLACEMENT_BOUNDS[0],
        le=MARKER_PLACEMENT_BOUNDS[1],
        description="How exactly the markers are put back in another fraction, standard deviation: 5 on bare skin, "
        "1 to 2 on tattoos",
    )
    warn_latency_ms: float = _limit("warn_latency_ms")
    max_latency_ms: Env[float] = _limit("max_latency_ms")
    camera_latency_ms: Env[float] = _limit("camera_latency_ms")
    max_model_age_min: float = _limit("max_model_age_min")
    max_unwritten_ms: float = _limit("max_unwritten_ms")
    max_service_silence_ms: float = _limit("max_service_silence_ms")
    operator_timeout_s: Env[float] = _limit("operator_timeout_s")
    min_breaths_per_min: float = _limit("min_breaths_per_min")
    max_breaths_per_min: float = _limit("max_breaths_per_min")
    beam_without_calibration: bool = Field(
        default=True, description="A session on the camera's own registration may be armed: research only"
    )
    checks_may_be_missing: Env[bool] = Field(
        default=True,
        description="The beam may be on where a check of the measurement (surface, color, camera) has not worked since "
        "the reference was set; research only. One that worked and cannot any more always holds",
    )
    countersignature: bool | None = Field(
        default=None,
        description="A second person countersigns reference and window before a fraction's first arming, and another "
        "window for a patient needs a reason; by default in clinical mode only",
    )
    holding_events: Env[EventList] = Field(
        default=tuple(sorted(BREATHING_CEASED)),
        description="Breathing events that hold the beam, comma-separated; see docs/2-clinical/breathing.md",
    )
    max_breath_hold_s: float = Field(
        default=HOLD_BOUNDS["timeout_s"][1], ge=HOLD_BOUNDS["timeout_s"][0], le=HOLD_BOUNDS["timeout_s"][1]
    )
    max_hold_still_mm: float = Field(
        default=2.0,
        ge=HOLD_BOUNDS["still"][0],
        le=HOLD_BOUNDS["still"][1],
        description="Largest range of a held breath while it settles, in a session's window; of a volume 0.1 l per mm",
    )
    max_hold_drift_mm: float = Field(
        default=3.0,
        ge=HOLD_BOUNDS["max_drift"][0],
        le=HOLD_BOUNDS["max_drift"][1],
        description="Largest drift of a held breath, in a session's window; of a volume 0.1 l per mm",
    )
    min_hold_settle_ms: float = Field(
        default=500.0,
        ge=HOLD_BOUNDS["settle_ms"][0],
        le=HOLD_BOUNDS["settle_ms"][1],
        description="Shortest time of a held breath before it counts, in a session's window",
    )
    max_baseline_correction_mm: float = Field(default=5.0, ge=0.0, le=50.0, description="Largest baseline correction")
    min_phase_confidence: float = Field(
        default=0.6, ge=0.1, le=1.0, description="Lowest confidence of the phase in a session's window"
    )
    window_lower_mm: float = Field(default=-100.0, ge=-100.0, le=100.0, description="Lowest edge of a session's window")
    window_upper_mm: float = Field(default=100.0, ge=-100.0, le=100.0, description="Highest edge of a session's window")

    @field_validator("holding_events", mode="before")
    @classmethod
    def _split_names(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        self._refuse_what_is_not_clinical()
        if self.window_lower_mm >= self.window_upper_mm:
            msg = f"window_lower_mm must be below window_upper_mm ({self.window_upper_mm:g})"
            raise ValueError(msg)
        self._refuse_contradictory_limits()
        self._refuse_other_scheme()
        try:
            _ = self.training  # refuses contradictory settings
        except InvalidValueError as error:
            name = SETTING_OF.get(error.field, f"training_{error.field}")
            msg = f"{name} must be {error.bound}"
            raise ValueError(msg) from error
        return self

    def _refuse_contradictory_limits(self) -> None:
        """Refuse limits that contradict each other though each is within its bound."""
        try:
            GateLimits(
                window=amplitude_window(lower_mm=-1.0, upper_mm=1.0),
                dwell_ms=self.min_dwell_ms,
                min_on_ms=self.min_on_ms,
                min_off_ms=self.min_off_ms,
                max_cycles_per_min=self.max_cycles_per_min,
                **self.gate_limits,
            )
        except InvalidValueError as error:
            msg = f"{setting_name(error.field)} is {error.value}: must be {error.bound}"
            raise ValueError(msg) from error
        a_frame = f"at least {1000.0 / self.min_fps:.1f}, one frame's time at"
        limits = (
            ("lease_ms", self.lease_ms * self.min_fps >= 1000.0, a_frame, "min_fps"),
            ("max_gap_ms", self.max_gap_ms * self.min_fps >= 1000.0, a_frame, "min_fps"),
            ("camera_latency_ms", self.camera_latency_ms < self.max_latency_ms, "less than", "max_latency_ms"),
            ("max_silence_ms", self.max_silence_ms >= self.max_frame_age_ms, "at least", "max_frame_age_ms"),
            ("watchdog_ms", self.watchdog_ms > self.lease_ms, "more than", "lease_ms"),
        )
        for name, is_met, words, other in limits:
            if not is_met:
                bound = f"{words} {setting_name(other)} ({getattr(self, other):g})"
                msg = f"{setting_name(name)} is {getattr(self, name):g}: must be {bound}"
                raise ValueError(msg)
        if 0.0 < self.operator_timeout_s < SHORTEST_OPERATOR_TIMEOUT_S:
            bound = f"0 (off) or at least {SHORTEST_OPERATOR_TIMEOUT_S:g}"
            msg = f"{PREFIX}OPERATOR_TIMEOUT_S is {self.operator_timeout_s:g}: must be {bound}"
            raise ValueError(msg)

    def _refuse_other_scheme(self) -> None:
        """Refuse a redirect URI by https where cookies are those of http, and the reverse."""
        if self.has_oidc_people and self.oidc_redirect_uri.startswith("https:") != self.is_secure:
            msg = (
                f"{PREFIX}OIDC_REDIRECT_URI must be {'https' if self.is_secure else 'http'}, as the service itself is "
                f"reached: {PREFIX}TLS_CERT or {PREFIX}BEHIND_PROXY=true make that https"
            )
            raise ValueError(msg)

    def _refuse_what_is_not_clinical(self) -> None:
        """Refuse everything at once that clinical mode lacks or does not permit, one line each."""
        lines = refusals(self, self.holding_events) if self.mode == "clinical" else ()
        if lines:
            raise ValueError("\n".join(lines))

    @property
    def gate_limits(self) -> dict[str, Any]:
        """Limits that a session cannot change, by the engine's names."""
        own = {"dwell_ms", "min_on_ms", "min_off_ms", "max_cycles_per_min"}
        return {name: getattr(self, name) for name in LIMIT_BOUNDS if name not in own}

    @property
    def needs_countersignature(self) -> bool:
        """Whether a second person countersigns a fraction's first arming."""
        return self.mode == "clinical" if self.countersignature is None else self.countersignature

    @property
    def bounds_position(self) -> bool:
        """Whether the site limits the window's position relative to the reference."""
        return (self.window_lower_mm, self.window_upper_mm) != (
            LIMIT_DEFAULTS["window_lower_mm"],
            LIMIT_DEFAULTS["window_upper_mm"],
        )

    @property
    def training(self) -> TrainingSettings:
        """Settings of the training."""
        given = _chosen(self, "training_")
        return TrainingSettings(**given, retrain_interval_s=60.0 * self.retrain_interval_min)

    @property
    def likeness(self) -> PatientMatchLimits:
        """Limits of the patient match."""
        return PatientMatchLimits(**_chosen(self, "likeness_"))

    @property
    def recording_folders(self) -> tuple[Path, ...]:
        """Folders from which recordings may be opened."""
        return self.recordings_dirs or (self.data_dir / "recordings",)

    @property
    def host_names(self) -> tuple[str, ...]:
        """Names accepted in the Host header; "*" is any."""
        if self.allowed_hosts:
            return self.allowed_hosts
        return ("*",) if self.is_remote else ("localhost", "127.0.0.1", "[::1]")


def _chosen(settings: Settings, prefix: str) -> dict[str, Any]:
    """Return a group's settings by the engine's names."""
    names = (name for name in Settings.model_fields if name.startswith(prefix))
    return {name.removeprefix(prefix): getattr(settings, name) for name in names}


def load_settings(**overrides: object) -> Settings:
    """Read the file and the environment; ``overrides`` from the command line take precedence.

    Raises
    ------
    SettingsError
        An unknown name in the file or the environment, or a value out of its bound; one line each.
    """
    _refuse_unknown(os.environ)
    given = {name: value for name, value in overrides.items() if value is not None}
    try:
        return Settings(**given)  # type: ignore[arg-type]
    except ValidationError as error:
        raise SettingsError("\n".join(_line(one["loc"], one["msg"]) for one in error.errors())) from error


def sources(overrides: Iterable[str] = ()) -> dict[str, str]:
    """Return where each setting comes from: the command line, the environment, the file, or the default."""
    path = config_path()
    fields = Settings.model_fields
    in_file = {} if path is None else read_config(path, {name: field.annotation for name, field in fields.items()})
    found = dict.fromkeys(fields, "default") | dict.fromkeys(in_file, str(path))
    variables = {name.upper() for name in os.environ}
    found |= {name: "environment" for name in OVERRIDES if f"{PREFIX}{name.upper()}" in variables}
    return found | dict.fromkeys(overrides, "command line")


def _refuse_unknown(names: Iterable[str]) -> None:
    own = [name for name in names if name.upper().startswith(PREFIX)]
    if f"{PREFIX}ALLOW_REMOTE" in own:
        raise SettingsError(
            f"{PREFIX}ALLOW_REMOTE was removed: set {PREFIX}TLS_CERT and {PREFIX}TLS_KEY, or "
            f"{PREFIX}BEHIND_PROXY=true if a proxy in front terminates TLS"
        )
    lines = unknown_variables(own, Settings.model_fields, OVERRIDES)
    if lines:
        raise SettingsError("\n".join(lines))


def _line(location: tuple[int | str, ...], message: str) -> str:
    """Name the setting of an error; a chosen bound of QA by its own key."""
    name = ".".join(("qa", *map(str, location[1:]))) if location[:1] == (CHOSEN,) else ""
    name = name or (setting_name(str(location[0])) if location else "")
    return f"{name}: {message.removeprefix('Value error, ')}".removeprefix(": ")
