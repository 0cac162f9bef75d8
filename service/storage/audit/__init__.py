"""The audit log: append-only rows in a hash chain; anchoring, verification and export of its rows."""

from service.storage.audit.chain import GENESIS_HASH, SYSTEM, Event, Outcome, append, canonical_json, seal
from service.storage.audit.verification import Breakage, Verification, verify
from service.storage.database.tables import AuditRow

__all__ = [
    "GENESIS_HASH",
    "SYSTEM",
    "AuditRow",
    "Breakage",
    "Event",
    "Outcome",
    "Verification",
    "append",
    "canonical_json",
    "seal",
    "verify",
]
