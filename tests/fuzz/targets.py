"""All targets, by name."""

from collections.abc import Mapping

from tests.fuzz import documents, kept_files, pictures, plans, requests
from tests.fuzz.target import Target

TARGETS: Mapping[str, Target] = {
    target.name: target for module in (pictures, documents, plans, kept_files, requests) for target in module.TARGETS
}
