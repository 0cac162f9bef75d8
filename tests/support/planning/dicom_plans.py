"""Plans made by somebody else's writer (pydicom), by construction: each says exactly what its builder was reported."""

from io import BytesIO
from typing import Any

from pydicom import dcmwrite
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import (
    PYDICOM_IMPLEMENTATION_UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)

PHOTON_CLASS = "1.2.840.10008.5.1.4.1.1.481.5"
ION_CLASS = "1.2.840.10008.5.1.4.1.1.481.8"
UID = "1.2.826.0.1.3680043.10.1474.1"
SYNTAXES = {
    "implicit little": ImplicitVRLittleEndian,
    "explicit little": ExplicitVRLittleEndian,
    "explicit big": ExplicitVRBigEndian,
    "deflated": DeflatedExplicitVRLittleEndian,
}
PATIENT_NAME = "Verysecret^Patientname"


def made(**values: Any) -> Dataset:
    """A data set of these elements."""
    item = Dataset()
    for name, value in values.items():
        if value is not None:
            setattr(item, name, Sequence(value) if isinstance(value, list) and name.endswith("Sequence") else value)
    return item


def motion(technique: str = "BREATH_HOLD", source: str | None = "EXTERNAL_MARKER", **more: Any) -> Dataset:
    return made(RespiratoryMotionCompensationTechnique=technique, RespiratorySignalSource=source, **more)


def setup(number: int = 1, *motions: Dataset, **more: Any) -> Dataset:
    sequence = list(motions) or None
    return made(PatientSetupNumber=number, PatientPosition="HFS", MotionSynchronizationSequence=sequence, **more)


def beam(
    number: int = 1, *, energies: tuple[float, ...] = (6.0,), setup_number: int | None = 1, **more: Any
) -> Dataset:
    points = [made(ControlPointIndex=index, NominalBeamEnergy=energy) for index, energy in enumerate(energies)]
    values = {
        "BeamNumber": number,
        "BeamName": f"Beam {number}",
        "BeamType": "DYNAMIC",
        "RadiationType": "PHOTON",
        "TreatmentDeliveryType": "TREATMENT",
        "TreatmentMachineName": "LINAC1",
        "PrimaryDosimeterUnit": "MU",
        "ReferencedPatientSetupNumber": setup_number,
        "ControlPointSequence": points,
        "NumberOfControlPoints": len(points),
    }
    return made(**{**values, **more})


def ion_beam(number: int = 1, *, energies: tuple[float, ...] = (70.0, 120.5), **more: Any) -> Dataset:
    points = [made(ControlPointIndex=index, NominalBeamEnergy=energy) for index, energy in enumerate(energies)]
    ion = {
        "RadiationType": "PROTON",
        "ScanMode": "MODULATED",
        "ControlPointSequence": None,
        "IonControlPointSequence": points,
    }
    return beam(number, **{**ion, **more})


def group(number: int = 1, *, beams: tuple[int, ...] = (1,), fractions: int | None = 30, **more: Any) -> Dataset:
    given = [made(ReferencedBeamNumber=one, BeamMeterset=123.4) for one in beams]
    item = made(FractionGroupNumber=number, NumberOfBeams=len(given), ReferencedBeamSequence=given, **more)
    item.NumberOfFractionsPlanned = fractions
    return item


def photon_plan(**changes: Any) -> Dataset:
    """A breath-hold plan of one photon beam; ``None`` leaves an element out."""
    values = {
        "SOPClassUID": PHOTON_CLASS,
        "SOPInstanceUID": UID,
        "Modality": "RTPLAN",
        "PatientID": "P-0001",
        "PatientName": PATIENT_NAME,
        "PatientBirthDate": "19500101",
        "RTPlanLabel": "LUNG_DIBH",
        "RTPlanName": "Lung left",
        "RTPlanDate": "20261120",
        "PlanIntent": "CURATIVE",
        "ApprovalStatus": "APPROVED",
        "FractionGroupSequence": [group()],
        "BeamSequence": [beam()],
        "PatientSetupSequence": [setup(1, motion())],
    }
    return made(**{**values, **changes})


def ion_plan(**changes: Any) -> Dataset:
    """A gated plan of one scanned proton beam."""
    values = {
        "SOPClassUID": ION_CLASS,
        "BeamSequence": None,
        "IonBeamSequence": [ion_beam()],
        "PatientSetupSequence": [setup(1, motion("GATING"))],
    }
    return photon_plan(**{**values, **changes})


def written(plan: Dataset, syntax: str = "explicit little", **meta_changes: Any) -> bytes:
    """Write a plan as a DICOM file."""
    uid = SYNTAXES[syntax]
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = plan.get("SOPClassUID", PHOTON_CLASS)
    meta.MediaStorageSOPInstanceUID = plan.get("SOPInstanceUID", UID)
    meta.TransferSyntaxUID = uid
    meta.ImplementationClassUID = PYDICOM_IMPLEMENTATION_UID
    meta.FileMetaInformationVersion = b"\x00\x01"
    for name, value in meta_changes.items():
        setattr(meta, name, value)
    plan.file_meta = meta
    plan.preamble = b"\0" * 128
    out = BytesIO()
    dcmwrite(
        out,
        plan,
        enforce_file_format=False,
        implicit_vr=uid == ImplicitVRLittleEndian,
        little_endian=uid != ExplicitVRBigEndian,
        force_encoding=True,
    )
    return out.getvalue()


def open_lengths(plan: Dataset) -> Dataset:
    """Let every sequence and item be written without its length, closed by delimiters."""
    for element in plan:
        if element.VR == "SQ":
            element.is_undefined_length = True
            for item in element.value:
                item.is_undefined_length_sequence_item = True
                open_lengths(item)
    return plan
