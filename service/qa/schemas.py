"""Requests and answers of the QA API: runs, results, trends, checks and baselines."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, AwareDatetime, ConfigDict, Field, SecretStr, StringConstraints, model_validator

from engine.qa import BASELINE_BOUNDS, PART_BOUNDS, REPEATS_BOUNDS, SECONDS_BOUNDS
from service.core.schemas.base import (
    Answer,
    Identifier,
    Name,
    Operator,
    Request,
    SourceText,
    broken,
    printable_or_empty,
)
from service.core.schemas.sessions import DeviceSource

Kind = Literal["daily", "monthly", "annual"]
RunKind = Literal["daily", "monthly", "annual", "latency"]
"""Kinds of stored runs: the latency is measured at the machine, by `tidegate qa latency`."""
Verdict = Literal["pass", "warn", "fail"]
RunStatus = Literal["running", "finished", "cancelled", "failed", "interrupted"]
PULSE_MS = (120.0, 200.0)
"""Range of the drills' lease [ms]: from twice the watchdog's deadline in its drill to the longest lease."""

MOST_START_US = 3_600_000_000


PARTS = ("plate", "phantom", "calibration_id")
Note = Annotated[str, StringConstraints(max_length=500), AfterValidator(printable_or_empty)]
Code = Annotated[SecretStr, Field(min_length=1, max_length=32)]
Position = Annotated[float, Field(ge=-100.0, le=100.0)]


class QaRecording(Request):
    """A recording in one of the site's recording folders; every frame is read once."""

    kind: Literal["recording"]
    path: SourceText = Field(
        description="Path, absolute or relative to one of the recording folders", examples=["qa/plate.oni"]
    )


QaSource = Annotated[QaRecording | DeviceSource, Field(discriminator="kind")]


class QaPlate(Request):
    """Frames of a flat plate or of the bare couch, facing the camera."""

    source: QaSource
    part: float = Field(
        default=0.5,
        ge=PART_BOUNDS[0],
        le=PART_BOUNDS[1],
        description="Central share of the picture's width and height that the plate covers",
    )
    seconds: float = Field(
        default=120.0, ge=SECONDS_BOUNDS[0], le=SECONDS_BOUNDS[1], description="Longest reading time [s]"
    )


class QaPhantom(Request):
    """Frames of a phantom with four markers that follows a commanded trace along the camera axis."""

    source: QaSource
    trace: SourceText = Field(
        description="CSV `time_s,position_mm` or a robot's file, in a recording folder", examples=["qa/sine.csv"]
    )
    window_lower_mm: Position = Field(
        description="Lower edge of the gating window in trace positions [mm]; one edge lies beyond the trace's range"
    )
    window_upper_mm: Position
    starts_us: int | None = Field(
        default=None,
        ge=0,
        le=MOST_START_US,
        description="Device time of the trace's time 0 [us]; default: the first frame",
    )
    seconds: float = Field(
        default=600.0, ge=SECONDS_BOUNDS[0], le=SECONDS_BOUNDS[1], description="Longest reading time [s]"
    )

    @model_validator(mode="after")
    def _is_a_window(self) -> Self:
        if self.window_lower_mm >= self.window_upper_mm:
            raise broken("window_lower_mm", self.window_lower_mm, f"below window_upper_mm ({self.window_upper_mm:g})")
        return self


class QaBeam(Request):
    """Number and duration [ms] of the beam pulses in the drills."""

    repeats: int = Field(default=20, ge=REPEATS_BOUNDS[0], le=REPEATS_BOUNDS[1])
    pulse_ms: float = Field(default=200.0, ge=PULSE_MS[0], le=PULSE_MS[1])


class QaFaults(Request):
    """Simulated deviations of a virtual set-up, to show that QA detects them."""

    offset_mm: float = Field(default=0.0, ge=-10.0, le=10.0)
    delay_ms: float = Field(default=0.0, ge=0.0, le=500.0)
    duty_change_percent: float = Field(default=0.0, ge=-20.0, le=20.0)
    drift_mm_per_min: float = Field(default=0.0, ge=-10.0, le=10.0)


class QaSimulation(Request):
    """A virtual plate, phantom and beam line; the same seed gives the same result."""

    seed: int = Field(default=1, ge=0, le=65_535)
    faults: QaFaults = Field(default=QaFaults())


class QaRunRequest(Request):
    """A QA run. On a real beam line its drills PERMIT THE BEAM without gating."""

    kind: Kind
    operator: Operator = ""
    calibration_id: Identifier | None = Field(
        default=None, description="Calibration of the camera; required with plate or phantom"
    )
    plate: QaPlate | None = None
    phantom: QaPhantom | None = Field(default=None, description="Required for monthly and annual QA")
    beam: QaBeam = Field(default=QaBeam())
    is_beam_safe: bool = Field(
        default=False,
        description="The operator confirms that the treatment room is empty and the accelerator is in a safe state; "
        "required on a real beam line",
    )
    code: Code | None = Field(
        default=None,
        description="One-time code that `tidegate qa code` displays at the machine; required on a real beam line, and "
        "not accepted otherwise",
    )
    simulation: QaSimulation | None = Field(
        default=None,
        description="Virtual set-up in place of plate and phantom, for demonstration in research mode; such a run does "
        "not count as QA",
    )
    note: Note = ""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "kind": "daily",
                    "operator": "A. Physicist",
                    "calibration_id": "0" * 32,
                    "plate": {"source": {"kind": "recording", "path": "qa/plate.oni"}},
                    "is_beam_safe": True,
                    "code": "7KQM-W2RT",
                }
            ]
        }
    )

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> Self:
        if self.simulation is not None:
            self._refuse(PARTS, "omitted: a simulated run has a virtual set-up")
            return self
        needed = PARTS if self.kind != "daily" else ("plate", "calibration_id")
        for name in needed:
            if getattr(self, name) is None:
                raise broken(name, "missing", f"given for {self.kind} QA")
        if self.kind == "daily":
            self._refuse(("phantom",), "omitted: daily QA uses no phantom")
        sources = [part.source.kind for part in (self.plate, self.phantom) if part is not None]
        if sources.count("device") > 1:
            bound = "recording: one camera cannot see plate and phantom in one request"
            raise broken("phantom.source.kind", "device", bound)
        return self

    @property
    def is_simulated(self) -> bool:
        """Whether the set-up is virtual."""
        return self.simulation is not None

    def _refuse(self, names: tuple[str, ...], bound: str) -> None:
        for name in names:
            if getattr(self, name) is not None:
                raise broken(name, "given", bound)


class QaProgress(Answer):
    """Progress of a run: completed and total steps of a stage; `total` is null if unknown."""

    stage: str = Field(examples=["plate"])
    done: int
    total: int | None


class QaRun(Answer):
    """A QA run with its current status."""

    id: Identifier
    kind: RunKind
    status: RunStatus
    status_detail: str
    verdict: Verdict | None
    operator: str
    site: str
    machine: str
    is_simulated: bool = Field(description="The set-up is virtual; the run does not count as QA")
    is_simulated_beam: bool
    software: str
    created_at: AwareDatetime
    ended_at: AwareDatetime | None
    progress: QaProgress | None = None


class QaResult(Answer):
    """The result of one check; `value` is null if it could not be measured, which is a fail."""

    code: str = Field(examples=["camera_distance_mm"])
    title: str
    value: float | None
    unit: str
    expected: float | None
    deviation: float | None = Field(description="Quantity that is compared with the bounds")
    uncertainty: float | None = Field(description="Standard error of the value")
    sidedness: Literal["absolute", "at_most"]
    warn: float
    fail: float
    verdict: Verdict
    detail: str


class QaCurve(Answer):
    """Points of a plot."""

    name: str
    x: list[float]
    y: list[float]


class QaSeries(Answer):
    """Data of a report's plot."""

    code: str
    title: str
    x_label: str
    y_label: str
    curves: list[QaCurve]


class QaRunDetail(QaRun):
    """A QA run with its checks and plot data."""

    note: str
    calibration_sha256: str | None
    baseline_number: int | None
    results: list[QaResult]
    series: list[QaSeries]
    sha256: str | None = Field(description="SHA-256 of the stored results; also in the audit log")


class QaRunPage(Answer):
    """A page of runs, newest first."""

    items: list[QaRun]
    next_cursor: str | None


class QaTrendPoint(Answer):
    """One check of one finished run."""

    run_id: Identifier
    kind: RunKind
    at: AwareDatetime
    value: float | None
    expected: float | None
    deviation: float | None
    warn: float
    fail: float
    verdict: Verdict


class QaTrend(Answer):
    """Values of a check in the newest runs, oldest first, without simulated runs."""

    check: str
    title: str
    unit: str
    sidedness: Literal["absolute", "at_most"]
    items: list[QaTrendPoint]


class QaCheck(Answer):
    """A check with this site's bounds."""

    code: str
    title: str
    unit: str
    method: str
    needs: Literal["plate", "phantom", "beam", "camera"]
    kinds: list[RunKind]
    sidedness: Literal["absolute", "at_most"]
    expected: float | None
    has_baseline: bool
    warn: float
    fail: float
    most: float = Field(description="Widest bound that a site may set")
    warn_setting: str = Field(examples=["qa.camera_distance_mm_warn"])
    fail_setting: str
    source: str


class QaCheckList(Answer):
    """All checks."""

    items: list[QaCheck]


def _baseline(code: str, example: float) -> float | None:
    low, high = BASELINE_BOUNDS[code]
    value: float | None = Field(default=None, ge=low, le=high, examples=[example])
    return value


class QaExpected(Request):
    """Baseline values from commissioning; an omitted value stays unchanged."""

    camera_distance_mm: float | None = _baseline("camera_distance_mm", 850.0)
    camera_tilt_x_deg: float | None = _baseline("camera_tilt_x_deg", 0.0)
    camera_tilt_y_deg: float | None = _baseline("camera_tilt_y_deg", 0.0)


class QaBaselineRequest(Request):
    """A new baseline of the camera's position, from given values or from a run's measurement."""

    operator: Operator = ""
    reason: Name = Field(examples=["camera mounted anew"])
    expected: QaExpected | None = None
    run_id: Identifier | None = Field(default=None, description="Use the values that this finished run measured")

    @model_validator(mode="after")
    def _says_what(self) -> Self:
        if (self.expected is None) is (self.run_id is None):
            raise broken("expected", "missing" if self.expected is None else "given", "given, or run_id: one of them")
        if self.expected is not None and not self.expected.model_dump(exclude_none=True):
            raise broken("expected", "empty", f"at least one of {', '.join(BASELINE_BOUNDS)}")
        return self


class QaBaseline(Answer):
    """Expected values of the camera's position and the person who set them; number 0: not set yet."""

    number: int
    expected: dict[str, float]
    set_by: str
    reason: str
    created_at: AwareDatetime | None


class QaBaselineHistory(QaBaseline):
    """The current baseline and the earlier ones, newest first."""

    earlier: list[QaBaseline]


class QaStatus(Answer):
    """The newest run of each kind, simulated runs excluded, and whether the QA requirement permits arming."""

    newest: dict[Kind, QaRun | None]
    required_daily_h: float = Field(description="Longest time since the last daily QA [h]; 0: no requirement")
    is_arming_allowed: bool
    refusal: str | None = Field(description="Why arming is refused, and what to do")
