"""Prescription of a fraction: the plan's beams in order, each with its beam-on time in seconds.

Errors that end a simulated fraction.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.simulated_tps.delivery import Beam
from service.client import Plan

if TYPE_CHECKING:
    from pydicom.dataset import Dataset
from engine.core.errors import TidegateError

MU_PER_MIN = 600.0
"""Dose rate that converts a meterset to seconds if no beam time is given."""
RT_PLAN_STORAGE = "1.2.840.10008.5.1.4.1.1.481.5"
IMPLEMENTATION_UID = "1.2.826.0.1.3680043.8.498.1"
BUILT_IN_BEAMS = (("G0 AP", 40.0), ("G90 LAT", 30.0))
NOT_TREATED = frozenset({"SETUP", "OPEN_PORTFILM", "TRMT_PORTFILM"})


class TpsError(TidegateError):
    """The simulated planning system cannot continue; the message gives the reason."""

    code = "tps_failed"


class FractionEndedError(TpsError):
    """The fraction ends before all its beams are delivered."""

    code = "tps_fraction_ended"


class SessionOverError(TpsError):
    """The session has ended before the fraction is delivered."""

    code = "tps_session_over"

    def __init__(self, status: str, detail: str) -> None:
        self.status = status
        super().__init__(f"the session is {status}: {detail or 'no reason given'}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Prescription:
    """An imported plan and the beams of one fraction."""

    plan_id: str
    label: str
    patient_reference: str
    fractions_planned: int | None
    beams: tuple[Beam, ...]


def prescription_of(plan: Plan, *, beam_s: float | None, mu_per_min: float = MU_PER_MIN) -> Prescription:
    """Return the prescription of the plan's first fraction group.

    Raises
    ------
    TpsError
        The plan has no treatment beam, or no meterset where ``beam_s`` is None.
    """
    group = plan["fraction_groups"][0]
    beams = {beam["number"]: beam for beam in plan["beams"]}
    ordered = [
        Beam(
            number=one["beam_number"],
            name=beams[one["beam_number"]]["name"] or f"beam {one['beam_number']}",
            seconds=_seconds(one["meterset"], beam_s, mu_per_min),
        )
        for one in group["beams"]
        if beams[one["beam_number"]]["delivery"] not in NOT_TREATED
    ]
    if not ordered:
        message = f"the plan {plan['label']} has no beam that is treated"
        raise TpsError(message)
    return Prescription(
        plan_id=plan["id"],
        label=plan["label"],
        patient_reference=plan["patient_reference"],
        fractions_planned=group["fractions_planned"],
        beams=tuple(ordered),
    )


def _seconds(meterset: float | None, beam_s: float | None, mu_per_min: float) -> float:
    if beam_s is not None:
        return beam_s
    if not meterset:
        message = "the plan has no meterset: give --beam-seconds"
        raise TpsError(message)
    return meterset / mu_per_min * 60.0


def built_in_plan(
    *,
    patient_id: str = "PHANTOM-1",
    uid: str = f"{IMPLEMENTATION_UID}.7.1",
    beams: Sequence[tuple[str, float]] = BUILT_IN_BEAMS,
    fractions: int = 30,
) -> bytes:
    """Return a DICOM file of a plan with photon beams and respiratory gating; beams are (name, meterset [MU])."""
    import pydicom
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import UID, ExplicitVRLittleEndian

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = UID(RT_PLAN_STORAGE), UID(uid)
    meta.TransferSyntaxUID, meta.ImplementationClassUID = ExplicitVRLittleEndian, UID(IMPLEMENTATION_UID)
    plan = _item(
        {
            "SOPClassUID": RT_PLAN_STORAGE,
            "SOPInstanceUID": uid,
            "Modality": "RTPLAN",
            "PatientID": patient_id,
            "PatientName": "",
            "PatientBirthDate": "",
            "PatientSex": "",
            "RTPlanLabel": "BUILT_IN",
            "RTPlanDate": "20261122",
            "PlanIntent": "RESEARCH",
            "ApprovalStatus": "UNAPPROVED",
            "StudyInstanceUID": f"{uid}.1",
            "SeriesInstanceUID": f"{uid}.2",
            "FractionGroupSequence": [_group([meterset for _, meterset in beams], fractions)],
            "BeamSequence": [_beam(number, name) for number, (name, _) in enumerate(beams, 1)],
            "PatientSetupSequence": [_setup()],
        }
    )
    plan.file_meta = meta
    file = io.BytesIO()
    pydicom.dcmwrite(file, plan, enforce_file_format=True)
    return file.getvalue()


def _group(metersets: Sequence[float], fractions: int) -> Mapping[str, object]:
    given = [{"ReferencedBeamNumber": number, "BeamMeterset": one} for number, one in enumerate(metersets, 1)]
    return {
        "FractionGroupNumber": 1,
        "NumberOfFractionsPlanned": fractions,
        "NumberOfBeams": len(given),
        "NumberOfBrachyApplicationSetups": 0,
        "ReferencedBeamSequence": given,
    }


def _beam(number: int, name: str) -> Mapping[str, object]:
    return {
        "BeamNumber": number,
        "BeamName": name,
        "BeamType": "STATIC",
        "RadiationType": "PHOTON",
        "TreatmentDeliveryType": "TREATMENT",
        "TreatmentMachineName": "SIMULATED",
        "PrimaryDosimeterUnit": "MU",
        "ReferencedPatientSetupNumber": 1,
        "NumberOfControlPoints": 1,
        "ControlPointSequence": [{"ControlPointIndex": 0, "NominalBeamEnergy": 6.0}],
    }


def _setup() -> Mapping[str, object]:
    gating = {"RespiratoryMotionCompensationTechnique": "GATING", "RespiratorySignalSource": "EXTERNAL_MARKER"}
    return {"PatientSetupNumber": 1, "PatientPosition": "HFS", "MotionSynchronizationSequence": [gating]}


def _item(elements: Mapping[str, object]) -> "Dataset":
    from pydicom.dataset import Dataset

    item = Dataset()
    for name, value in elements.items():
        setattr(item, name, [_item(one) for one in value] if isinstance(value, list) else value)
    return item
