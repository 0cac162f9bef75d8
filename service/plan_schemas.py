"""What is read of an RT Plan, and what goes over HTTP of it. Nothing here names a patient but the site's reference."""

from typing import Literal

from pydantic import AwareDatetime, ConfigDict, Field

from service.schema_base import Answer, Identifier, Name, Operator, Request
from service.schemas import Regions, Session, Source
from service.window_schemas import Window

PlanKind = Literal["RT Plan", "RT Ion Plan"]
Prescribed = Literal["not_stated", "none", "breath_hold", "gating", "unknown", "mixed", "other"]
GATING_WORDS = (
    "What the plan says about breathing (Motion Synchronization Sequence of its patient setups). `gating`: a window of "
    "amplitude or phase; `breath_hold`: one with a breath hold; `not_stated`: nothing; `none`: no compensation; "
    "`unknown`: that it is not known; `mixed`: not the same for all beams; `other`: a technique that is not done here"
)


class PlanMotion(Answer):
    """One technique that a patient setup prescribes, in DICOM's own terms."""

    technique: str = Field(
        description="Respiratory Motion Compensation Technique (0018,9170)", examples=["BREATH_HOLD"]
    )
    signal_source: str | None = Field(description="Respiratory Signal Source (0018,9171)", examples=["EXTERNAL_MARKER"])
    description: str | None = Field(description="The planner's own words (0018,9185)")


class PlanSetup(Answer):
    """How the patient is set up, as far as breathing goes."""

    number: int
    label: str | None
    motion: list[PlanMotion]


class PlanBeam(Answer):
    """A beam."""

    number: int
    name: str | None
    type: str | None = Field(description="STATIC or DYNAMIC", examples=["DYNAMIC"])
    radiation: str | None = Field(examples=["PHOTON"])
    delivery: str | None = Field(description="TREATMENT, SETUP, ...: what is not treated has no say about gating")
    machine: str | None
    scan_mode: str | None = Field(description="Of an ion beam")
    energies: list[float] = Field(description="Each once, rising")
    energy_unit: Literal["MV", "MeV", "MeV/u"] | None = Field(description="null: the plan does not let it be known")
    setup_number: int | None


class PlanFractionBeam(Answer):
    """What a beam gives in one fraction."""

    beam_number: int
    meterset: float | None = Field(description="In the beam's own unit, most often MU")


class PlanFractionGroup(Answer):
    """Fractions that are alike."""

    number: int
    fractions_planned: int | None
    beams: list[PlanFractionBeam]


class RtPlan(Answer):
    """What is read of the file, and nothing else of it is kept."""

    kind: PlanKind
    sop_instance_uid: str = Field(examples=["1.2.826.0.1.3680043.8.498.1"])
    patient_reference: str = Field(description="Patient ID (0010,0020), or its keyed hash where the site says so")
    label: str = Field(examples=["LUNG_DIBH"])
    name: str | None
    date: str | None = Field(description="YYYYMMDD", examples=["20261122"])
    intent: str | None = Field(examples=["CURATIVE"])
    approval: str | None = Field(examples=["APPROVED"])
    fraction_groups: list[PlanFractionGroup]
    beams: list[PlanBeam]
    setups: list[PlanSetup]
    gating: Prescribed = Field(description=GATING_WORDS)
    notes: list[str] = Field(description="To be read by the person who imports")


class PlanContradiction(Answer):
    """A later file with the plan's UID that says something else; the plan stays as it was read first."""

    approval: str | None = Field(description="The later file's approval", examples=["REJECTED"])
    differing: list[str] = Field(description="What of the plan it says otherwise", examples=[["approval", "notes"]])
    imported_by: str
    created_at: AwareDatetime


class Plan(RtPlan):
    """A plan as it is kept; it is never changed nor removed."""

    id: Identifier
    sha256: str = Field(description="Of the file as it came first; the file itself is not kept")
    imported_by: str
    created_at: AwareDatetime
    contradicted: PlanContradiction | None = Field(
        description="The newest file that said something else under this UID: no session comes of it without a person"
    )


class PlanSummary(Answer):
    """A plan in a list."""

    id: Identifier
    kind: PlanKind
    sop_instance_uid: str
    patient_reference: str
    label: str
    gating: Prescribed
    imported_by: str
    created_at: AwareDatetime


class PlanPage(Answer):
    """Newest first; `next_cursor` is null on the last page."""

    items: list[PlanSummary]
    next_cursor: str | None


class PlanSessionRequest(Request):
    """What a plan cannot say of a session: the camera, the calibration, the edges of the window, which fraction."""

    fraction_number: int = Field(ge=1, le=200)
    fraction_group: int | None = Field(
        default=None, ge=0, le=2_147_483_647, description="Its number; needed where the plan has several"
    )
    operator: Operator = ""
    source: Source
    calibration_id: Identifier | None = None
    window: Window = Field(description="No element of DICOM holds its edges: they come from the site's protocol")
    regions: Regions = Field(default=Regions())
    model_id: Identifier | None = None
    overrides_plan_gating: Name | None = Field(
        default=None, description="Why the window is not of the plan's technique; persons only, and in the audit"
    )
    repeats_fraction: Name | None = Field(
        default=None, description="Why a fraction that was begun before is treated again; persons only, in the audit"
    )
    overrides_contradiction: Name | None = Field(
        default=None, description="Why a plan that a later file contradicts is treated; persons only, in the audit"
    )

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "fraction_number": 1,
                    "operator": "A. Therapist",
                    "source": {"kind": "recording", "path": "demo/recording.oni", "player": "auto"},
                    "calibration_id": "0" * 32,
                    "window": {"kind": "breath_hold", "lower_mm": 8.0, "upper_mm": 12.0},
                }
            ]
        }
    )


class PreparedSession(Session):
    """A session made from a plan, and what whoever starts it should know."""

    warnings: list[str] = Field(description="Where the plan and the session do not say the same, or the plan is silent")
