"""A row of the audit as a DICOM audit message (PS3.15, A.5.1): the XML that ATNA's repositories take.

What was sealed goes along as details of the message's own row: sequence, seals and, where it tells nothing of a patient
or patients were asked for, the row's detail.
"""

import base64
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from service.audit.chain import SYSTEM, Link
from service.audit.codes import APPLICATION_ROLE, Code, meaning_of, outcome_of
from service.audit.patients import Patient, is_about_patient, parsed

DCM = "DCM"
OURS = "99TIDEGATE"
"""A private coding scheme, as DICOM numbers them."""
OBJECT_IDS = "RFC-3881"
ROW_KIND = Code("audit-row", "Row of the audit log")
SESSION_KIND = Code("session", "Gating session")
PATIENT_NUMBER = Code("2", "Patient Number")
DECLARATION = b'<?xml version="1.0" encoding="UTF-8"?>'
NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Who sends: the machine that runs Tidegate, and the site it stands at."""

    host_name: str
    site: str

    @property
    def process_id(self) -> str:
        """The sending process, by the number its machine knows it by."""
        return str(os.getpid())


def audit_message(link: Link, *, source: Source, patient: Patient | None = None, with_patients: bool = False) -> bytes:
    """Write a row as a message, UTF-8."""
    detail = parsed(link.detail) or {}
    is_told = with_patients or not is_about_patient(link, patient)
    message = ET.Element("AuditMessage")
    _identify(message, link, detail if is_told else {})
    _participate(message, link, detail, source)
    sender = ET.SubElement(message, "AuditSourceIdentification", AuditSourceID=_token(source.host_name))
    if source.site:
        sender.set("AuditEnterpriseSiteID", _token(source.site))
    ET.SubElement(sender, "AuditSourceTypeCode", {"csd-code": "4"})
    _name_objects(message, link, is_told=is_told)
    if patient is not None and with_patients:
        _object(message, PATIENT_NUMBER, OBJECT_IDS, patient.reference, kind="1", role="1")
    # In one line: syslog daemons escape what would begin another.
    return DECLARATION + ET.tostring(message, encoding="unicode").encode()


def _identify(message: ET.Element, link: Link, detail: Mapping[str, object]) -> None:
    meaning = meaning_of(link.action)
    event = ET.SubElement(
        message,
        "EventIdentification",
        EventActionCode=meaning.letter,
        EventDateTime=link.at,
        EventOutcomeIndicator=outcome_of(link.action, link.outcome),
    )
    _coded(event, "EventID", meaning.event, DCM)
    if meaning.type is not None:
        _coded(event, "EventTypeCode", meaning.type, DCM)
    _coded(event, "EventTypeCode", Code(link.action, link.action), OURS)
    said = detail.get("message") or detail.get("detail")
    description = ET.SubElement(event, "EventOutcomeDescription")
    description.text = _token(f"{link.outcome}: {said}" if isinstance(said, str) and said else link.outcome)


def _participate(message: ET.Element, link: Link, detail: Mapping[str, object], source: Source) -> None:
    """Name whoever acted, and ourselves."""
    if link.actor != SYSTEM:
        person = _participant(message, link.actor, is_requestor=True)
        roles = detail.get("roles")
        for role in roles if isinstance(roles, list) else []:
            _coded(person, "RoleIDCode", Code(str(role), str(role)), OURS)
    other = detail.get("on_behalf_of")
    if isinstance(other, str) and other:
        _participant(message, other, is_requestor=False)
    process = _participant(message, SYSTEM, is_requestor=link.actor == SYSTEM)
    process.set("AlternativeUserID", source.process_id)
    process.set("NetworkAccessPointID", _token(source.host_name))
    process.set("NetworkAccessPointTypeCode", "1")
    _coded(process, "RoleIDCode", APPLICATION_ROLE, DCM)


def _name_objects(message: ET.Element, link: Link, *, is_told: bool) -> None:
    row = _object(message, ROW_KIND, OURS, str(link.sequence), kind="2", role="13")
    sealed = {"hash": link.hash, "previous_hash": link.previous_hash, "outcome": link.outcome}
    for name, value in {**sealed, **({"detail": link.detail} if is_told else {})}.items():
        ET.SubElement(row, "ParticipantObjectDetail", type=name, value=base64.b64encode(value.encode()).decode())
    if link.session_id is not None:
        _object(message, SESSION_KIND, OURS, link.session_id, kind="2", role="20")


def _participant(message: ET.Element, name: str, *, is_requestor: bool) -> ET.Element:
    return ET.SubElement(message, "ActiveParticipant", UserID=_clean(name), UserIsRequestor=str(is_requestor).lower())


def _object(message: ET.Element, kind_of_id: Code, system: str, value: str, *, kind: str, role: str) -> ET.Element:
    found = ET.SubElement(
        message,
        "ParticipantObjectIdentification",
        ParticipantObjectID=_token(value),
        ParticipantObjectTypeCode=kind,
        ParticipantObjectTypeCodeRole=role,
    )
    _coded(found, "ParticipantObjectIDTypeCode", kind_of_id, system)
    ET.SubElement(found, "ParticipantObjectName").text = _token(kind_of_id.meaning)
    return found


def _coded(parent: ET.Element, name: str, code: Code, system: str) -> None:
    said = {"csd-code": _token(code.value), "codeSystemName": system, "originalText": _token(code.meaning)}
    ET.SubElement(parent, name, said)


def _token(text: str) -> str:
    """Write a text as XML's tokens are: no space at its ends, none doubled."""
    return " ".join(_clean(text).split())


def _clean(text: str) -> str:
    """Replace what no XML may hold."""
    return NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
