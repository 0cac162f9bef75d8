"""Who may call what, as a table made from the table of rules.

Run: ``python -m tests.support.documents.access_matrix --write``.
"""

from functools import partial

from service.core.permissions import KEY_PERMISSIONS, MEANING, ROLE_PERMISSIONS, Permission, Role
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

DOCUMENT = ROOT / "docs" / "3-operate" / "access.md"


def permissions_table() -> str:
    """Write what each permission lets do, and which roles have it."""
    lines = [f"| permission | lets | {' | '.join(Role)} | a machine |", f"|---|---|{'---|' * (len(Role) + 1)}"]
    for permission in Permission:
        marks = ["yes" if permission in ROLE_PERMISSIONS[role] else "" for role in Role]
        marks.append("yes" if permission in KEY_PERMISSIONS else "never")
        lines.append(f"| `{permission}` | {MEANING[permission]} | {' | '.join(marks)} |")
    return "\n".join(lines)


MADE = {"permissions": permissions_table}
"""Every part of the document that the code makes, by its name there."""

main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
