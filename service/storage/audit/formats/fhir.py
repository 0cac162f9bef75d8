"""A row of the audit as a FHIR R4 ``AuditEvent``.

An extension holds the hashed fields, so that the export can be verified without the database; the detail only if it has
no patient data or patient data was requested.
"""

from collections.abc import Mapping

from service.storage.audit.chain import SYSTEM, Link
from service.storage.audit.formats.codes import APPLICATION_ROLE, Code, meaning_of, outcome_of
from service.storage.audit.patients import Patient, is_about_patient, parsed

DCM = "http://dicom.nema.org/resources/ontology/DCM"
SOURCE_TYPES = "http://terminology.hl7.org/CodeSystem/security-source-type"
ENTITY_TYPES = "http://terminology.hl7.org/CodeSystem/audit-entity-type"
ENTITY_ROLES = "http://terminology.hl7.org/CodeSystem/object-role"
HUMAN = {
    "system": "http://terminology.hl7.org/CodeSystem/extra-security-role-type",
    "code": "humanuser",
    "display": "human user",
}
OURS = "urn:tidegate:"
ACTIONS = f"{OURS}audit-action"
USERS = f"{OURS}user"
ROLES = f"{OURS}role"
SESSIONS = f"{OURS}session"
PATIENTS = f"{OURS}patient-reference"
SITES = f"{OURS}site"
SEAL = f"{OURS}audit-seal"


def audit_event(
    link: Link, *, site: str, patient: Patient | None = None, with_patients: bool = False
) -> dict[str, object]:
    """Return a row as a resource; ``patient`` is the patient of its session."""
    meaning = meaning_of(link.action)
    types = [] if meaning.type is None else [_dcm(meaning.type)]
    with_detail = with_patients or not is_about_patient(link, patient)
    detail = (parsed(link.detail) or {}) if with_detail else {}
    message = detail.get("message") or detail.get("detail")
    resource: dict[str, object] = {
        "resourceType": "AuditEvent",
        "id": f"tidegate-{link.sequence}",
        "extension": [_seal(link, with_detail=with_detail)],
        "type": _dcm(meaning.event),
        "subtype": [*types, {"system": ACTIONS, "code": link.action}],
        "action": meaning.letter,
        "recorded": link.at,
        "outcome": outcome_of(link.action, link.outcome),
        "outcomeDesc": f"{link.outcome}: {message}" if isinstance(message, str) and message else link.outcome,
        "agent": _agents(link, parsed(link.detail) or {}),
        "source": {
            "site": site or "tidegate",
            "observer": {"identifier": {"system": SITES, "value": site or "tidegate"}, "display": "Tidegate"},
            "type": [{"system": SOURCE_TYPES, "code": "4", "display": "Application Server"}],
        },
    }
    entities = _entities(link, patient if with_patients else None)
    return {**resource, "entity": entities} if entities else resource


def sealed_row(resource: Mapping[str, object]) -> tuple[Link, bool] | None:
    """Return the row in a resource and whether it has its detail; None if there is no row."""
    extensions = resource.get("extension")
    for extension in extensions if isinstance(extensions, list) else []:
        if isinstance(extension, dict) and extension.get("url") == SEAL:
            return _row_of(extension.get("extension"))
    return None


def _row_of(parts: object) -> tuple[Link, bool] | None:
    fields: dict[str, object] = {}
    for part in parts if isinstance(parts, list) else []:
        if isinstance(part, dict):
            value = part.get("valuePositiveInt", part.get("valueString"))
            fields[str(part.get("url"))] = value
    has_detail = "detail" in fields
    try:
        link = Link(
            sequence=int(str(fields["sequence"])),
            at=str(fields["at"]),
            actor=str(fields["actor"]),
            action=str(fields["action"]),
            outcome=str(fields["outcome"]),
            session_id=None if fields.get("session") is None else str(fields["session"]),
            detail=str(fields.get("detail", "")),
            previous_hash=str(fields["previousHash"]),
            hash=str(fields["hash"]),
        )
    except (KeyError, ValueError):
        return None
    return link, has_detail


def _seal(link: Link, *, with_detail: bool) -> dict[str, object]:
    fields = {"at": link.at, "actor": link.actor, "action": link.action, "outcome": link.outcome}
    fields |= {} if link.session_id is None else {"session": link.session_id}
    fields |= {"detail": link.detail} if with_detail else {}
    fields |= {"previousHash": link.previous_hash, "hash": link.hash}
    parts: list[dict[str, object]] = [{"url": "sequence", "valuePositiveInt": link.sequence}]
    parts += [{"url": name, "valueString": value} for name, value in fields.items()]
    return {"url": SEAL, "extension": parts}


def _agents(link: Link, detail: Mapping[str, object]) -> list[dict[str, object]]:
    agents = [_agent(link.actor, detail.get("roles"), is_requestor=link.actor != SYSTEM)]
    other = detail.get("on_behalf_of")
    if isinstance(other, str) and other:
        agents.append(_agent(other, None, is_requestor=False))
    return agents


def _agent(name: str, roles: object, *, is_requestor: bool) -> dict[str, object]:
    kind = _dcm(APPLICATION_ROLE) if name == SYSTEM else HUMAN
    names = [str(role) for role in roles] if isinstance(roles, list) else []
    agent: dict[str, object] = {
        "type": {"coding": [kind]},
        "who": {"identifier": {"system": USERS, "value": name}, "display": name},
        "name": name,
        "requestor": is_requestor,
    }
    return {**agent, "role": [{"coding": [{"system": ROLES, "code": role}]} for role in names]} if names else agent


def _entities(link: Link, patient: Patient | None) -> list[dict[str, object]]:
    found: list[dict[str, object]] = []
    if link.session_id is not None:
        found.append(_entity(SESSIONS, link.session_id, ("2", "System Object"), ("20", "Job")))
    if patient is not None:
        found.append(_entity(PATIENTS, patient.reference, ("1", "Person"), ("1", "Patient")))
    return found


def _entity(system: str, value: str, kind: tuple[str, str], role: tuple[str, str]) -> dict[str, object]:
    return {
        "what": {"identifier": {"system": system, "value": value}},
        "type": {"system": ENTITY_TYPES, "code": kind[0], "display": kind[1]},
        "role": {"system": ENTITY_ROLES, "code": role[0], "display": role[1]},
    }


def _dcm(code: Code) -> dict[str, str]:
    return {"system": DCM, "code": code.value, "display": code.meaning}
