"""A session as DICOM: its curve as Multi-channel Respiratory Waveform, its report as Encapsulated PDF.

The curve (PS3.3 A.34.16) has a channel for the thorax and one for the abdomen, at a constant rate: each frame in its
place, a place without a measurement padded, the frames' true times beside it. Beam and gate are annotations. No viewer
shows such a curve, so the report goes beside it as a document.
"""

import hashlib
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from pydicom.charset import convert_encodings, default_encoding
from pydicom.dataelem import RawDataElement
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sr.coding import Code
from pydicom.uid import (
    EncapsulatedPDFStorage,
    ExplicitVRLittleEndian,
    MultichannelRespiratoryWaveformStorage,
)

from engine import __version__
from service.core.errors import BoundError
from service.exchange.curve import BEAM_ON, BreathingCurve, Stretch

CHANNELS = {
    "thorax": Code("130431", "DCM", "Thoracic Respiratory Effort"),
    "abdomen": Code("130432", "DCM", "Abdominal Respiratory Effort"),
}
"""Sources of CID 3005, in the order of the channels."""
MILLIMETRE = Code("mm", "UCUM", "mm")
STEP_MM = 0.001
"""Sensitivity: values of 32 bits reach farther than any body moves, at a hundredth of the sensor's noise."""
PADDING = -(2**31)
UTF_8, CHINESE = "ISO_IR 192", "ISO 2022 IR 58"
CHINESE_ESCAPE = b"\x1b$)A"
PRIVATE_GROUP, CREATOR = 0x0099, "TIDEGATE"
TRUE_TIMES, PLACES = 0x01, 0x02
MOST_TEXT = 64
TIME_FORM = "%Y%m%d%H%M%S.%f%z"
DEIDENTIFIED = "Name, birth date, sex and times removed; identifiers replaced"


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """Whom and what an export is about.

    Attributes
    ----------
    patient_id
        The site's reference for the patient.
    session_id
        Its UIDs follow from it, so that an export made again is the same object.
    character_set
        Terms of (0008,0005) that the plan's names were read in; empty is UTF-8.
    """

    patient_id: str
    session_id: str
    plan_label: str = ""
    plan_uid: str = ""
    fraction: str = ""
    room: str = ""
    machine: str = ""
    camera: str = ""
    begun_at: datetime | None = None
    character_set: tuple[str, ...] = ()
    is_deidentified: bool = field(default=False)

    def deidentified(self, patient_id: str) -> "Subject":
        """Return the subject under another identifier, without place, plan and times.

        Raises
        ------
        BoundError
            The identifier is empty or longer than DICOM takes.
        """
        if not 1 <= len(patient_id.strip()) <= MOST_TEXT:
            bound = f"1 to {MOST_TEXT} characters"
            msg = f"deidentify must be {bound}"
            raise BoundError(msg, field="deidentify", value=patient_id[:MOST_TEXT], bound=bound)
        new = hashlib.sha256(f"{self.session_id}/{patient_id}".encode()).hexdigest()[:32]
        return Subject(patient_id=patient_id.strip(), session_id=new, is_deidentified=True)


def waveform(subject: Subject, curve: BreathingCurve) -> bytes:
    """Return the curve as a DICOM file; the same bytes for the same session."""
    places, rate = curve.places()
    made = _dataset(subject, MultichannelRespiratoryWaveformStorage, "RESP", "waveform")
    at = subject.begun_at
    made.AcquisitionDateTime = "" if at is None else f"{at:%Y%m%d%H%M%S.%f}+0000"
    made.AcquisitionContextSequence = []
    made.WaveformSequence = [_group(curve, places, rate)]
    made.WaveformAnnotationSequence = [
        _annotation(stretch, places, number) for number, stretch in enumerate([*curve.beams(), *curve.holds()], start=1)
    ]
    block = made.private_block(PRIVATE_GROUP, CREATOR, create=True)
    block.add_new(TRUE_TIMES, "OD", curve.time_s.astype("<f8").tobytes())
    block.add_new(PLACES, "OL", places.astype("<u4").tobytes())
    return _file(made)


def report_document(subject: Subject, pdf: bytes) -> bytes:
    """Return the session's report as a DICOM file; ``subject`` must be the one that the report names."""
    made = _dataset(subject, EncapsulatedPDFStorage, "DOC", "report")
    made.ConversionType = "WSD"
    made.AcquisitionDateTime = ""
    made.BurnedInAnnotation = "YES"
    made.DocumentTitle = "Gating session"
    made.ConceptNameCodeSequence = []
    made.MIMETypeOfEncapsulatedDocument = "application/pdf"
    made.EncapsulatedDocumentLength = len(pdf)
    made.EncapsulatedDocument = pdf + b"\0" * (len(pdf) % 2)
    return _file(made)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReadWaveform:
    """What `read_waveform` finds: values [mm] at the frames' true times [s], NaN where padded."""

    time_s: np.ndarray
    motion_mm: dict[str, np.ndarray]
    rate: float
    annotations: tuple[str, ...]
    is_on: np.ndarray
    patient_id: str
    begun_at: datetime | None


def read_waveform(content: bytes) -> ReadWaveform:
    """Read what `waveform` wrote, by pydicom's own reading of the samples."""
    from pydicom import dcmread

    found = dcmread(io.BytesIO(content))
    (group,) = found.WaveformSequence
    block = found.private_block(PRIVATE_GROUP, CREATOR)
    places = np.frombuffer(block[PLACES].value, "<u4")
    values = found.waveform_array(0)[places]
    raw = np.frombuffer(group.WaveformData, "<i4").reshape(-1, len(CHANNELS))[places]
    values = np.where(raw == PADDING, np.nan, values)
    is_on = np.zeros(len(places), dtype=bool)
    for one in found.WaveformAnnotationSequence:
        if one.UnformattedTextValue == BEAM_ON:
            first, last = one.ReferencedSamplePositions
            is_on |= (first <= places + 1) & (places < last)
    at = str(found.AcquisitionDateTime)
    return ReadWaveform(
        time_s=np.frombuffer(block[TRUE_TIMES].value, "<f8"),
        motion_mm={name: values[:, channel] for channel, name in enumerate(CHANNELS)},
        rate=float(group.SamplingFrequency),
        annotations=tuple(one.UnformattedTextValue for one in found.WaveformAnnotationSequence),
        is_on=is_on,
        patient_id=str(found.PatientID),
        begun_at=datetime.strptime(at, TIME_FORM) if at else None,  # noqa: DTZ007 - the form has %z
    )


def _dataset(subject: Subject, sop_class: str, modality: str, kind: str) -> Dataset:
    """Return the modules that both objects share."""
    made = Dataset()
    made.SpecificCharacterSet = _character_set(subject)
    made.SOPClassUID = sop_class
    made.SOPInstanceUID = _uid(subject, kind)
    made.PatientName = ""
    made.PatientID = subject.patient_id
    made.PatientBirthDate = ""
    made.PatientSex = ""
    if subject.is_deidentified:
        made.PatientIdentityRemoved = "YES"
        made.DeidentificationMethod = DEIDENTIFIED
    at = subject.begun_at
    day, time = ("", "") if at is None else (f"{at:%Y%m%d}", f"{at:%H%M%S.%f}")
    made.StudyInstanceUID = _uid(subject, "study")
    made.StudyDate, made.StudyTime = day, time
    made.ReferringPhysicianName = ""
    made.StudyID = subject.session_id[:16]
    made.AccessionNumber = ""
    made.StudyDescription = _cut(" ".join(filter(None, ("Respiratory gating", subject.plan_label, subject.fraction))))
    made.Modality = modality
    made.SeriesInstanceUID = _uid(subject, f"{kind} series")
    made.SeriesNumber = 1 if kind == "waveform" else 2
    made.InstanceNumber = 1
    made.ContentDate, made.ContentTime = day or "19000101", time or "000000"
    if at is not None:
        made.TimezoneOffsetFromUTC = "+0000"
    made.Manufacturer = "Tidegate"
    made.ManufacturerModelName = _cut(subject.camera or "camera not known")
    made.DeviceSerialNumber = _cut(subject.room or "room not named")
    made.SoftwareVersions = __version__
    made.StationName = subject.machine[:16]
    if subject.plan_uid:
        plan = Dataset()
        plan.ReferencedSOPClassUID = "1.2.840.10008.5.1.4.1.1.481.5"
        plan.ReferencedSOPInstanceUID = subject.plan_uid
        made.ReferencedInstanceSequence = [plan]
    return made


def _group(curve: BreathingCurve, places: np.ndarray, rate: float) -> Dataset:
    values = np.full((int(places[-1]) + 1, len(CHANNELS)), PADDING, dtype="<i4")
    for channel, name in enumerate(CHANNELS):
        motion = curve.motion_mm[name]
        known = np.isfinite(motion)
        values[places[known], channel] = np.rint(motion[known] / STEP_MM)
    group = Dataset()
    group.MultiplexGroupLabel = "Skin motion"
    group.WaveformOriginality = "DERIVED"
    group.NumberOfWaveformChannels = len(CHANNELS)
    group.NumberOfWaveformSamples = len(values)
    group.SamplingFrequency = f"{rate:.10g}"
    group.ChannelDefinitionSequence = [_channel(name) for name in CHANNELS]
    group.WaveformBitsAllocated = 32
    group.WaveformSampleInterpretation = "SL"
    group.add_new("WaveformPaddingValue", "OW", np.array(PADDING, dtype="<i4").tobytes())
    group.add_new("WaveformData", "OW", values.tobytes())
    return group


def _channel(name: str) -> Dataset:
    channel = Dataset()
    channel.ChannelLabel = name.capitalize()
    channel.ChannelSourceSequence = [_code(CHANNELS[name])]
    channel.ChannelSensitivity = f"{STEP_MM:g}"
    channel.ChannelSensitivityUnitsSequence = [_code(MILLIMETRE)]
    channel.ChannelSensitivityCorrectionFactor = "1"
    channel.ChannelBaseline = "0"  # readers disagree whether a sensitivity scales it
    channel.ChannelSampleSkew = "0"
    channel.WaveformBitsStored = 32
    return channel


def _annotation(stretch: Stretch, places: np.ndarray, number: int) -> Dataset:
    made = Dataset()
    made.ReferencedWaveformChannels = [1, 0]  # all channels of the first group
    made.TemporalRangeType = "SEGMENT"
    made.ReferencedSamplePositions = [int(places[stretch.first]) + 1, int(places[stretch.last]) + 1]
    made.AnnotationGroupNumber = number
    made.UnformattedTextValue = stretch.text
    return made


def _code(code: Code) -> Dataset:
    made = Dataset()
    made.CodeValue, made.CodingSchemeDesignator, made.CodeMeaning = code.value, code.scheme_designator, code.meaning
    return made


def _character_set(subject: Subject) -> str | list[str]:
    """Return the plan's character set where everything can be written in it, otherwise UTF-8."""
    terms = list(subject.character_set)
    if terms and all(_is_written(text, terms) for text in _texts(subject)):
        return terms if len(terms) > 1 else terms[0]
    return UTF_8


def _texts(subject: Subject) -> Iterator[str]:
    yield from (subject.patient_id, subject.plan_label, subject.fraction, subject.room, subject.machine, subject.camera)


def _is_written(text: str, terms: Sequence[str]) -> bool:
    """Whether each character is in one of the sets: pydicom would write another in place of one that is in none."""
    encodings = convert_encodings(list(terms))
    return all(any(_has(encoding, one) for encoding in encodings) for one in text)


def _has(encoding: str, character: str) -> bool:
    try:
        character.encode("ascii" if encoding == default_encoding else encoding)
    except UnicodeError:
        return False
    return True


def _uid(subject: Subject, kind: str) -> str:
    """Return a UID of the form 2.25 that follows from session and kind."""
    digest = hashlib.sha256(f"tidegate/{subject.session_id}/{kind}".encode()).digest()
    return f"2.25.{int.from_bytes(digest[:16], 'big')}"


def _cut(text: str) -> str:
    return text.replace("\\", "/")[:MOST_TEXT].strip()


def _escape_chinese(made: Dataset) -> None:
    """Write text of ISO 2022 IR 58 with its escape sequence, which pydicom (3.0.2) leaves out."""
    for element in list(made):
        text = element.value
        if element.VR not in {"LO", "SH"} or not isinstance(text, str) or text.isascii():
            continue
        raw = b"".join(
            piece.encode("ascii") if piece.isascii() else CHINESE_ESCAPE + piece.encode("gb2312")
            for piece in re.findall(r"[\x00-\x7f]+|[^\x00-\x7f]+", text)
        )
        raw += b" " * (len(raw) % 2)
        made[element.tag] = RawDataElement(
            element.tag, element.VR, len(raw), raw, 0, is_implicit_VR=False, is_little_endian=True
        )


def _file(made: Dataset) -> bytes:
    if CHINESE in made.SpecificCharacterSet:
        _escape_chinese(made)
    made.file_meta = FileMetaDataset()
    made.file_meta.MediaStorageSOPClassUID = made.SOPClassUID
    made.file_meta.MediaStorageSOPInstanceUID = made.SOPInstanceUID
    made.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    to = io.BytesIO()
    made.save_as(to, enforce_file_format=True)
    return to.getvalue()
