"""All targets, by name."""

from collections.abc import Mapping

from verification.fuzz import documents, own_files, plans, recordings, requests
from verification.fuzz.target import Target

TARGETS: Mapping[str, Target] = {
    target.name: target for module in (recordings, documents, plans, own_files, requests) for target in module.TARGETS
}
