"""The tables of docs/3-operate/clinical.md, from the code: ``python -m tests.support.documents.clinical`` prints them.

With ``--write`` it puts them into the document instead.
"""

import json
from functools import partial

from service.core.settings.clinical import CLINICAL_BOUNDS
from service.core.settings.names import place_of, setting_name
from service.core.settings.settings import Settings
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT
from tests.support.service.clinical_site import OBLIGATORY

DOCUMENT = ROOT / "docs" / "3-operate" / "clinical.md"


def bound_table() -> str:
    """One row a setting: its default, its bounds in research and in clinical mode, and the reason."""
    head = ["| setting | default | research | clinical | reason |", "|---|---|---|---|---|"]
    return "\n".join(head + [_row(name) for name in CLINICAL_BOUNDS])


def _row(name: str) -> str:
    field, bound = Settings.model_fields[name], CLINICAL_BOUNDS[name]
    research = {kind: getattr(one, kind) for one in field.metadata for kind in ("ge", "le") if hasattr(one, kind)}
    is_usable = field.default is None or bound.low <= field.default <= bound.high
    value = "by kind" if field.default is None else f"{field.default:g}"
    default = value if is_usable else f"**{value}**"
    wide = f"{research['ge']:g} to {research['le']:g}"
    return f"| `{setting_name(name)}` | {default} | {wide} | {bound.text} | {bound.reason} |"


def smallest_set() -> str:
    """The obligatory settings as a file, without the beam line's."""
    sections: dict[str, list[str]] = {}
    for name, value in {"mode": "clinical", **OBLIGATORY}.items():
        section, key = place_of(name)
        sections.setdefault(section, []).append(f"{key} = {json.dumps(value)}")
    parts = [f"[{section}]\n" + "\n".join(lines) for section, lines in sections.items()]
    return "```\n" + "\n\n".join(parts) + "\n```"


MADE = {"smallest": smallest_set, "bounds": bound_table}
"""Every part of the document that the code makes, by its name there."""
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
