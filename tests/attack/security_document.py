"""The generated parts of docs/security.md: ``python -m tests.attack.security_document --write``."""

import sys
from pathlib import Path

from service.door_settings import DoorSettings
from service.middleware import SECURITY_HEADERS
from service.settings import PREFIX
from tests.fuzz import record

PAGE = Path(__file__).parents[2] / "docs/security.md"


def limits() -> str:
    """Every setting of the doors, with its default and bounds."""
    rows = []
    for name, field in DoorSettings.model_fields.items():
        low, high = (getattr(one, key) for one in field.metadata for key in ("ge", "le") if hasattr(one, key))
        rows.append(f"| `{PREFIX}{name.upper()}` | {field.default:g} | {low:g} to {high:g} | {field.description} |")
    return "\n".join(["| setting | default | may be | what it bounds |", "|---|---|---|---|", *rows])


def headers() -> str:
    """Every header that an answer carries."""
    rows = [f"| `{name}` | `{value}` |" for name, value in SECURITY_HEADERS.items()]
    return "\n".join(["| header | value |", "|---|---|", *rows])


PARTS = {"limits": limits, "headers": headers, "fuzz": record.table}


def written(page: str) -> str:
    """Put the generated parts into the page."""
    for name, make in PARTS.items():
        begin, end = f"<!-- made: {name} -->\n\n", f"\n\n<!-- end: {name} -->"
        head, _, rest = page.partition(begin)
        page = head + begin + make() + end + rest.partition(end)[2]
    return page


if __name__ == "__main__" and "--write" in sys.argv:
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
