"""The generated parts of docs/3-operate/security.md: ``python -m verification.attack.security_document --write``."""

from dataclasses import fields
from functools import partial

from service.core.settings.groups import ConnectionLimits
from service.web.middleware.requests import SECURITY_HEADERS
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT
from verification.fuzz import record

DOCUMENT = ROOT / "docs" / "3-operate" / "security.md"


def limits() -> str:
    """Every limit of a connection."""
    rows = [f"| `{one.name}` | {one.default:g} | {one.metadata['what']} |" for one in fields(ConnectionLimits)]
    return "\n".join(["| limit | value | what it bounds |", "|---|---|---|", *rows])


def headers() -> str:
    """Every header that an answer carries."""
    rows = [f"| `{name}` | `{value}` |" for name, value in SECURITY_HEADERS.items()]
    return "\n".join(["| header | value |", "|---|---|", *rows])


MADE = {"limits": limits, "headers": headers, "fuzz": record.table}
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
