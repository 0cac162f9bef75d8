"""Who may call what, as a table made from the table of rules: ``python -m tests.access.matrix --write``."""

import argparse
import sys
from pathlib import Path

from service.access.permissions import KEY_PERMISSIONS, MEANING, ROLE_PERMISSIONS, Permission, Role
from service.access.rules import RULES, Needs, Open

PAGE = Path(__file__).parents[2] / "docs" / "access.md"
MARKS = {name: (f"<!-- made: {name} -->", f"<!-- end: {name} -->") for name in ("permissions", "matrix")}


def permissions_table() -> str:
    """Write what each permission lets do, and which roles have it."""
    lines = [f"| permission | lets | {' | '.join(Role)} | a machine |", f"|---|---|{'---|' * (len(Role) + 1)}"]
    for permission in Permission:
        marks = ["yes" if permission in ROLE_PERMISSIONS[role] else "" for role in Role]
        marks.append("yes" if permission in KEY_PERMISSIONS else "never")
        lines.append(f"| `{permission}` | {MEANING[permission]} | {' | '.join(marks)} |")
    return "\n".join(lines)


def matrix_table() -> str:
    """Write what each call needs."""
    lines = ["| call | needs |", "|---|---|"]
    lines += [f"| `{method} {template}` | {_words(needs)} |" for (method, template), needs in RULES.items()]
    return "\n".join(lines)


def _words(needs: Needs) -> str:
    return needs.value if isinstance(needs, Open) else f"`{needs}`"


def with_tables(text: str) -> str:
    """Put the tables into the page's text."""
    for name, table in (("permissions", permissions_table()), ("matrix", matrix_table())):
        first, last = MARKS[name]
        before, _, rest = text.partition(first)
        _, _, after = rest.partition(last)
        text = f"{before}{first}\n\n{table}\n\n{last}{after}"
    return text


def main() -> None:
    """Print the tables, or write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="into docs/access.md")
    if parser.parse_args().write:
        PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        sys.stdout.write(f"{permissions_table()}\n\n{matrix_table()}\n")


if __name__ == "__main__":
    main()
