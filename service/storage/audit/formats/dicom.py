"""A row of the audit as a DICOM audit message (PS3.15, A.5.1): the XML that ATNA's repositories take.

The message contains the row's sequence and hashes, and its detail if that has no patient data or patient data was
requested.
"""

import base64
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from service.storage.audit.chain import SYSTEM, Link
from service.storage.audit.formats.codes import APPLICATION_ROLE, Code, meaning_of, outcome_of
from service.storage.audit.patients import Patient, is_about_patient, parsed

DCM = "DCM"
OURS = "99TIDEGATE"
"""Private coding scheme designator (99 prefix, PS3.16)."""
OBJECT_IDS = "RFC-3881"
ROW_KIND = Code("audit-row", "Row of the audit log")
SESSION_KIND = Code("session", "Gating session")
PATIENT_NUMBER = Code("2", "Patient Number")
DECLARATION = b'<?xml version="1.0" encoding="UTF-8"?>'
NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """The sender: host and site."""

    host_name: str
    site: str

    @property
    def process_id(self) -> str:
        """Process id of the sender."""
        return str(os.getpid())


def audit_message(link: Link, *, source: Source, patient: Patient | None = None, with_patients: bool = False) -> bytes:
    """Return a row as one line of XML, UTF-8; patient data only with ``with_patients``."""
    detail = parsed(link.detail) or {}
    with_detail = with_patients or not is_about_patient(link, patient)
    message = ET.Element("AuditMessage")
    _identify(message, link, detail if with_detail else {})
    _participate(message, link, detail, source)
    sender = ET.SubElement(message, "AuditSourceIdentification", AuditSourceID=_token(source.host_name))
    if source.site:
        sender.set("AuditEnterpriseSiteID", _token(source.site))
    ET.SubElement(sender, "AuditSourceTypeCode", {"csd-code": "4"})
    _name_objects(message, link, with_detail=with_detail)
    if patient is not None and with_patients:
        _object(message, PATIENT_NUMBER, OBJECT_IDS, patient.reference, kind="1", role="1")
    # On one line, since syslog daemons escape line breaks.
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
    outcome_text = detail.get("message") or detail.get("detail")
    description = ET.SubElement(event, "EventOutcomeDescription")
    description.text = _token(
        f"{link.outcome}: {outcome_text}" if isinstance(outcome_text, str) and outcome_text else link.outcome
    )


def _participate(message: ET.Element, link: Link, detail: Mapping[str, object], source: Source) -> None:
    """Add the actor, the person on whose behalf, and this process."""
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


def _name_objects(message: ET.Element, link: Link, *, with_detail: bool) -> None:
    row = _object(message, ROW_KIND, OURS, str(link.sequence), kind="2", role="13")
    sealed = {"hash": link.hash, "previous_hash": link.previous_hash, "outcome": link.outcome}
    for name, value in {**sealed, **({"detail": link.detail} if with_detail else {})}.items():
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
    fields = {"csd-code": _token(code.value), "codeSystemName": system, "originalText": _token(code.meaning)}
    ET.SubElement(parent, name, fields)


def _token(text: str) -> str:
    """Normalise white space as in an XML token."""
    return " ".join(_clean(text).split())


def _clean(text: str) -> str:
    """Replace characters that XML does not allow."""
    return NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
