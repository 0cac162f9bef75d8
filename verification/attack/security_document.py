"""The generated parts of docs/3-operate/security.md: ``python -m verification.attack.security_document --write``."""

from functools import partial

from service.core.settings.groups import ConnectionSettings
from service.core.settings.names import setting_name
from service.web.middleware.requests import SECURITY_HEADERS
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT
from verification.fuzz import record

DOCUMENT = ROOT / "docs" / "3-operate" / "security.md"


def limits() -> str:
    """Every setting of the doors, with its default and bounds."""
    rows = []
    for name, field in ConnectionSettings.model_fields.items():
        low, high = (getattr(one, key) for one in field.metadata for key in ("ge", "le") if hasattr(one, key))
        rows.append(f"| `{setting_name(name)}` | {field.default:g} | {low:g} to {high:g} | {field.description} |")
    return "\n".join(["| setting | default | may be | what it bounds |", "|---|---|---|---|", *rows])


def headers() -> str:
    """Every header that an answer carries."""
    rows = [f"| `{name}` | `{value}` |" for name, value in SECURITY_HEADERS.items()]
    return "\n".join(["| header | value |", "|---|---|", *rows])


MADE = {"limits": limits, "headers": headers, "fuzz": record.table}
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
