"""QA over HTTP, in and out: what a run is given, how it came out, its trend, the table of checks and the baseline."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, AwareDatetime, ConfigDict, Field, StringConstraints, model_validator

from engine.qa.bounds import BASELINE_BOUNDS
from engine.qa.inputs import PART_BOUNDS, REPEATS_BOUNDS, SECONDS_BOUNDS
from service.schema_base import Answer, Identifier, Name, Operator, Request, SourceText, broken
from service.schemas import DeviceSource

Kind = Literal["daily", "monthly", "annual"]
Verdict = Literal["pass", "warn", "fail"]
RunStatus = Literal["running", "finished", "cancelled", "failed", "interrupted"]
PULSE_MS = (120.0, 200.0)
"""Leases of the drills: twice the watchdog's deadline in its drill, and no longer than any lease."""

MOST_START_US = 3_600_000_000


def _printable_or_empty(text: str) -> str:
    if not text.isprintable():
        msg = "must be printable characters"
        raise ValueError(msg)
    return text


PARTS = ("plate", "phantom", "calibration_id")
Note = Annotated[str, StringConstraints(max_length=500), AfterValidator(_printable_or_empty)]
Position = Annotated[float, Field(ge=-100.0, le=100.0)]


class QaRecording(Request):
    """A recording inside one of the folders that the site allows; every frame is read once."""

    kind: Literal["recording"]
    path: SourceText = Field(
        description="Absolute, or relative to one of the allowed folders", examples=["qa/plate.oni"]
    )


QaSource = Annotated[QaRecording | DeviceSource, Field(discriminator="kind")]


class QaPlate(Request):
    """Frames of a flat plate, or of the bare couch, that faces the camera."""

    source: QaSource
    part: float = Field(
        default=0.5,
        ge=PART_BOUNDS[0],
        le=PART_BOUNDS[1],
        description="Share of the picture's width and height, in the middle, that the plate fills",
    )
    seconds: float = Field(default=120.0, ge=SECONDS_BOUNDS[0], le=SECONDS_BOUNDS[1], description="Read at most")


class QaPhantom(Request):
    """Frames of a phantom with four markers that moves along a commanded trace, towards the camera."""

    source: QaSource
    trace: SourceText = Field(
        description="CSV `time_s,position_mm`, or a robot's file, in an allowed folder", examples=["qa/sine.csv"]
    )
    window_lower_mm: Position = Field(description="Gating window in the trace's positions; one edge beyond its reach")
    window_upper_mm: Position
    starts_us: int | None = Field(
        default=None, ge=0, le=MOST_START_US, description="Device time of the trace's time 0; the first frame's if not"
    )
    seconds: float = Field(default=600.0, ge=SECONDS_BOUNDS[0], le=SECONDS_BOUNDS[1], description="Read at most")

    @model_validator(mode="after")
    def _is_a_window(self) -> Self:
        if self.window_lower_mm >= self.window_upper_mm:
            raise broken("window_lower_mm", self.window_lower_mm, f"below window_upper_mm ({self.window_upper_mm:g})")
        return self


class QaBeam(Request):
    """How often the drills turn the line on, and for how long."""

    repeats: int = Field(default=20, ge=REPEATS_BOUNDS[0], le=REPEATS_BOUNDS[1])
    pulse_ms: float = Field(default=200.0, ge=PULSE_MS[0], le=PULSE_MS[1])


class QaFaults(Request):
    """What is wrong with a virtual set-up, to see QA find it."""

    offset_mm: float = Field(default=0.0, ge=-10.0, le=10.0)
    delay_ms: float = Field(default=0.0, ge=0.0, le=500.0)
    duty_change_percent: float = Field(default=0.0, ge=-20.0, le=20.0)
    drift_mm_per_min: float = Field(default=0.0, ge=-10.0, le=10.0)


class QaSimulation(Request):
    """A virtual plate, phantom and beam line; the same seed shows the same."""

    seed: int = Field(default=1, ge=0, le=65_535)
    faults: QaFaults = Field(default=QaFaults())


class QaRunRequest(Request):
    """A QA run. Its drills PERMIT THE BEAM, outside of any gating, where the site has a real beam line."""

    kind: Kind
    operator: Operator = ""
    calibration_id: Identifier | None = Field(default=None, description="The camera's; needed with plate or phantom")
    plate: QaPlate | None = None
    phantom: QaPhantom | None = Field(default=None, description="For monthly and annual")
    beam: QaBeam = Field(default=QaBeam())
    is_beam_safe: bool = Field(
        default=False,
        description="The operator's word that nobody is in the room and the accelerator is made safe; without it no "
        "run is started on a real beam line",
    )
    simulation: QaSimulation | None = Field(
        default=None, description="Instead of plate and phantom, for demonstration: counts for nothing; research only"
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
                }
            ]
        }
    )

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> Self:
        if self.simulation is not None:
            self._refuse(PARTS, "left out: a simulated run has its own")
            return self
        needed = PARTS if self.kind != "daily" else ("plate", "calibration_id")
        for name in needed:
            if getattr(self, name) is None:
                raise broken(name, "missing", f"given for {self.kind} QA")
        if self.kind == "daily":
            self._refuse(("phantom",), "left out: daily QA asks for none")
        sources = [part.source.kind for part in (self.plate, self.phantom) if part is not None]
        if sources.count("device") > 1:
            bound = "recording: one camera cannot see plate and phantom in one request"
            raise broken("phantom.source.kind", "device", bound)
        return self

    @property
    def is_simulated(self) -> bool:
        """Whether nothing real is measured."""
        return self.simulation is not None

    def _refuse(self, names: tuple[str, ...], bound: str) -> None:
        for name in names:
            if getattr(self, name) is not None:
                raise broken(name, "given", bound)


class QaProgress(Answer):
    """How far a run has come."""

    stage: str = Field(examples=["plate"])
    done: int
    total: int | None


class QaRun(Answer):
    """A QA run, as it stands."""

    id: Identifier
    kind: Kind
    status: RunStatus
    status_detail: str
    verdict: Verdict | None
    operator: str
    site: str
    machine: str
    is_simulated: bool = Field(description="Virtual from end to end: counts for nothing")
    is_simulated_beam: bool
    software: str
    created_at: AwareDatetime
    ended_at: AwareDatetime | None
    progress: QaProgress | None = None


class QaResult(Answer):
    """One check of a run, judged; `value` is null where it could not be measured, which is a fail."""

    code: str = Field(examples=["camera_distance_mm"])
    title: str
    value: float | None
    unit: str
    expected: float | None
    deviation: float | None = Field(description="What is held against the bounds")
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
    """What a plot of a report shows."""

    code: str
    title: str
    x_label: str
    y_label: str
    curves: list[QaCurve]


class QaRunDetail(QaRun):
    """A QA run with every check and what its plots show."""

    note: str
    calibration_sha256: str | None
    baseline_number: int | None
    results: list[QaResult]
    series: list[QaSeries]
    sha256: str | None = Field(description="Of the judged results as they were written; the audit has it too")


class QaRunPage(Answer):
    """A page of runs, newest first."""

    items: list[QaRun]
    next_cursor: str | None


class QaTrendPoint(Answer):
    """One check of one finished run."""

    run_id: Identifier
    kind: Kind
    at: AwareDatetime
    value: float | None
    expected: float | None
    deviation: float | None
    warn: float
    fail: float
    verdict: Verdict


class QaTrend(Answer):
    """A check over the newest runs, oldest first; simulated runs are left out."""

    check: str
    title: str
    unit: str
    sidedness: Literal["absolute", "at_most"]
    items: list[QaTrendPoint]


class QaCheck(Answer):
    """One thing that is checked, with this site's bounds."""

    code: str
    title: str
    unit: str
    method: str
    needs: Literal["plate", "phantom", "beam"]
    kinds: list[Kind]
    sidedness: Literal["absolute", "at_most"]
    expected: float | None
    has_baseline: bool
    warn: float
    fail: float
    most: float = Field(description="Widest bound that a site may choose")
    warn_setting: str = Field(examples=["TIDEGATE_QA_CAMERA_DISTANCE_MM_WARN"])
    fail_setting: str
    source: str


class QaCheckList(Answer):
    """Every check there is."""

    items: list[QaCheck]


def _baseline(code: str, example: float) -> float | None:
    low, high = BASELINE_BOUNDS[code]
    value: float | None = Field(default=None, ge=low, le=high, examples=[example])
    return value


class QaExpected(Request):
    """What was read when the site was commissioned; what is left out keeps what it was."""

    camera_distance_mm: float | None = _baseline("camera_distance_mm", 850.0)
    camera_tilt_x_deg: float | None = _baseline("camera_tilt_x_deg", 0.0)
    camera_tilt_y_deg: float | None = _baseline("camera_tilt_y_deg", 0.0)


class QaBaselineRequest(Request):
    """A named person fixes what the camera's place should read, by hand or as a run measured it."""

    operator: Operator = ""
    reason: Name = Field(examples=["camera mounted anew"])
    expected: QaExpected | None = None
    run_id: Identifier | None = Field(default=None, description="Take over what this finished run measured")

    @model_validator(mode="after")
    def _says_what(self) -> Self:
        if (self.expected is None) is (self.run_id is None):
            raise broken("expected", "missing" if self.expected is None else "given", "given, or run_id: one of them")
        if self.expected is not None and not self.expected.model_dump(exclude_none=True):
            raise broken("expected", "empty", f"at least one of {', '.join(BASELINE_BOUNDS)}")
        return self


class QaBaseline(Answer):
    """What the camera's place should read, and who fixed it; number 0 is none yet."""

    number: int
    expected: dict[str, float]
    set_by: str
    reason: str
    created_at: AwareDatetime | None


class QaBaselineHistory(QaBaseline):
    """The baseline that holds, and those before it, newest first."""

    earlier: list[QaBaseline]


class QaStatus(Answer):
    """The newest run of each kind that counts, and whether the site's QA lets anybody arm."""

    newest: dict[Kind, QaRun | None]
    required_daily_h: float = Field(description="0: this site does not ask")
    is_arming_allowed: bool
    refusal: str | None = Field(description="Why nobody arms, and what would help")
