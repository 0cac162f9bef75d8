"""docs/problems.md, made from the catalogue: ``python -m tests.contract.problems_document --write``."""

import argparse
import sys
from pathlib import Path

from service.app import create_app
from service.problem_catalogue import CATALOGUE
from service.settings import Settings

PAGE = Path(__file__).parents[2] / "docs" / "problems.md"
HEAD = """# Problems

Everything that is refused is answered as a problem (RFC 9457, `application/problem+json`): `type` is
`urn:tidegate:problem:<code>`, and `code` is what a program looks at. Codes are stable: none changes its meaning, and
none goes without the notice that docs/api.md promises; `title` and `detail` are for people and may change. Where one
value broke a bound, `field`, `value` and `bound` name it, and `errors` all of them, up to 20. A problem never tells
what is inside: no path of the server, no stack, no query, no secret; what was sent as a password is never shown again.

`408`, `414`, `431` and `501` may come of any request: they are answered before anything looks at what is asked for.

Made from the code by `python -m tests.contract.problems_document --write`; a test says when it is stale.

| code | status | when | what to do | where |
|---|---|---|---|---|
"""
MANY = 12


def page() -> str:
    """Write the page."""
    where = _where()
    rows = [
        f"| `{code}` | {entry.status} | {entry.when} | {entry.what_to_do} | {_named(where.get(code, []))} |"
        for code, entry in CATALOGUE.items()
    ]
    return HEAD + "\n".join(rows) + "\n"


def _where() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for item in create_app(Settings()).openapi()["paths"].values():
        for operation in item.values():
            for answer in operation["responses"].values():
                for code in answer.get("x-problem-codes", ()):
                    found.setdefault(code, []).append(operation["operationId"])
    return found


def _named(operations: list[str]) -> str:
    if not operations:
        return "any request"
    if len(operations) > MANY:
        return f"{len(operations)} calls"
    return ", ".join(f"`{one}`" for one in sorted(set(operations)))


def main() -> None:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    if parser.parse_args().write:
        PAGE.write_text(page(), encoding="utf-8")
    else:
        sys.stdout.write(page())


if __name__ == "__main__":
    main()
