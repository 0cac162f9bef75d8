"""Schemas of RT Plans; the only identification of the patient is the site's reference."""

from typing import Literal

from pydantic import AwareDatetime, ConfigDict, Field

from service.core.schemas.base import Answer, Identifier, Name, Operator, Request
from service.core.schemas.sessions import CONTINUES, HEAD_WORDS, HeadSide, Regions, Session, SessionStatus, Source
from service.core.schemas.windows import Window

PlanKind = Literal["RT Plan", "RT Ion Plan"]
Prescribed = Literal["not_stated", "none", "breath_hold", "gating", "unknown", "mixed", "other"]
GATING_WORDS = (
    "The plan's breathing technique (Motion Synchronization Sequence of its patient setups). `gating`: a window of "
    "amplitude or phase; `breath_hold`: one with a breath hold; `not_stated`: nothing; `none`: no compensation; "
    "`unknown`: that it is not known; `mixed`: not the same for all beams; `other`: a technique that is not done here"
)


class PlanMotion(Answer):
    """A motion compensation technique of a patient setup, in DICOM terms."""

    technique: str = Field(
        description="Respiratory Motion Compensation Technique (0018,9170)", examples=["BREATH_HOLD"]
    )
    signal_source: str | None = Field(description="Respiratory Signal Source (0018,9171)", examples=["EXTERNAL_MARKER"])
    description: str | None = Field(description="Free-text description (0018,9185)")


class PlanSetup(Answer):
    """A patient setup: its position on the couch and its respiratory techniques."""

    number: int
    label: str | None
    motion: list[PlanMotion]
    position: str | None = Field(
        default=None,
        description="Patient Position (0018,5100); null if the file has none, or was imported before it was read",
        examples=["HFS"],
    )


class PlanBeam(Answer):
    """A beam of the plan."""

    number: int
    name: str | None
    type: str | None = Field(description="STATIC or DYNAMIC", examples=["DYNAMIC"])
    radiation: str | None = Field(examples=["PHOTON"])
    delivery: str | None = Field(
        description="TREATMENT, SETUP, ...; only treatment beams count for the gating technique"
    )
    machine: str | None
    scan_mode: str | None = Field(description="Scan mode of an ion beam")
    energies: list[float] = Field(description="Distinct values, ascending")
    energy_unit: Literal["MV", "MeV", "MeV/u"] | None = Field(description="null if the plan does not define it")
    setup_number: int | None


class PlanFractionBeam(Answer):
    """Meterset of a beam in one fraction."""

    beam_number: int
    meterset: float | None = Field(description="In the beam's dosimeter unit, usually MU")


class PlanFractionGroup(Answer):
    """A group of identical fractions."""

    number: int
    fractions_planned: int | None
    beams: list[PlanFractionBeam]


class RtPlan(Answer):
    """The content that is read and stored from the file."""

    kind: PlanKind
    sop_instance_uid: str = Field(examples=["1.2.826.0.1.3680043.8.498.1"])
    patient_reference: str = Field(description="Patient ID (0010,0020), or its keyed hash if the site uses hashes")
    label: str = Field(examples=["LUNG_DIBH"])
    name: str | None
    date: str | None = Field(description="YYYYMMDD", examples=["20261122"])
    intent: str | None = Field(examples=["CURATIVE"])
    approval: str | None = Field(examples=["APPROVED"])
    fraction_groups: list[PlanFractionGroup]
    beams: list[PlanBeam]
    setups: list[PlanSetup]
    gating: Prescribed = Field(description=GATING_WORDS)
    notes: list[str] = Field(description="Notes for the person who imports the plan")
    character_set: list[str] = Field(
        default=[], description="Terms of Specific Character Set (0008,0005) in which names were read; empty is ASCII"
    )


class PlanContradiction(Answer):
    """A later file with the same UID and different content; the plan keeps the content of the first file."""

    approval: str | None = Field(description="Approval status of the later file", examples=["REJECTED"])
    differing: list[str] = Field(description="Names of the fields that differ", examples=[["approval", "notes"]])
    imported_by: str
    created_at: AwareDatetime


class Plan(RtPlan):
    """A stored plan; plans are never changed or removed."""

    id: Identifier
    sha256: str = Field(description="SHA-256 of the first file; the file itself is not stored")
    imported_by: str
    created_at: AwareDatetime
    contradicted: PlanContradiction | None = Field(
        description="The newest file with this UID and different content; a session then needs a person's override"
    )


class PlanLastSession(Answer):
    """The newest session of a plan's patient and label that was started."""

    id: Identifier
    status: SessionStatus
    fraction_number: int | None
    started_at: AwareDatetime


class PlanSummary(Answer):
    """A plan in a list, with what was done of it."""

    id: Identifier
    kind: PlanKind
    sop_instance_uid: str
    patient_reference: str
    label: str
    gating: Prescribed
    imported_by: str
    created_at: AwareDatetime
    fractions_planned: int | None = Field(description="Of its largest fraction group; null if the file has none")
    next_fraction: int = Field(description="One more than the highest fraction number that was started", examples=[3])
    last_session: PlanLastSession | None


class PlanPage(Answer):
    """Newest first; `next_cursor` is null on the last page."""

    items: list[PlanSummary]
    next_cursor: str | None


class PlanSessionRequest(Request):
    """The part of a session that the plan does not define: camera, calibration, edges of the window, fraction."""

    fraction_number: int = Field(ge=1, le=200)
    fraction_group: int | None = Field(
        default=None,
        ge=0,
        le=2_147_483_647,
        description="Number of the fraction group; required if the plan has several",
    )
    operator: Operator = ""
    source: Source
    calibration_id: Identifier | None = None
    window: Window = Field(
        description="DICOM has no element for the window's edges; they come from the site's protocol"
    )
    regions: Regions = Field(default=Regions())
    model_id: Identifier | None = None
    head_direction: HeadSide | None = Field(
        default=None,
        description=f"{HEAD_WORDS}; if left out, it follows from the plan's Patient Position and the site's gantry"
        " side. It must not contradict them",
    )
    continues: Identifier | None = Field(default=None, description=CONTINUES)
    overrides_plan_gating: Name | None = Field(
        default=None,
        description="Reason for a window that does not match the plan's technique; people "
        "only, recorded in the audit log",
    )
    repeats_fraction: Name | None = Field(
        default=None,
        description="Reason for repeating a fraction that was started before; people only, recorded in the audit log",
    )
    overrides_contradiction: Name | None = Field(
        default=None,
        description="Reason for treating a plan that a later file contradicts; people only, recorded in the audit log",
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
    """A session created from a plan, with notes for the operator."""

    warnings: list[str] = Field(description="Points where plan and session differ or the plan is silent")
