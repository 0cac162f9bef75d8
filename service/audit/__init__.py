"""The audit log: append-only rows in a chain of hashes, its heads anchored outside, walked, exported, passed on."""

from service.audit.chain import GENESIS_HASH, SYSTEM, Event, Outcome, append, canonical_json, seal
from service.audit.walk import Breakage, Verification, verify
from service.db.models import AuditRow

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
