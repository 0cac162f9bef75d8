"""Outcomes of the mutants by package: `python -m verification.mutants.summary` prints them.

With `--write` it puts them into docs/5-evidence/mutants.md. It reads the files that mutmut left in ``mutants/``
(`make mutants`). Mutants that survived are explained in survivors.md; the exit code is 1 when one is not.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from tests.support.generated_sections import write_parts
from tests.support.repository import ROOT

PAGE = ROOT / "docs" / "5-evidence" / "mutants.md"
EXPLAINED = Path(__file__).with_name("survivors.md")
LEFT_BEHIND = ROOT / "mutants"
COLUMNS = ("killed", "caught by types", "timed out", "suspicious", "survived", "not run")
_OF_EXIT_CODE: dict[int | None, str] = {
    None: "not run",
    0: "survived",
    1: "killed",
    3: "killed",
    5: "survived",
    33: "survived",
    35: "suspicious",
    36: "timed out",
    37: "caught by types",
    24: "timed out",
    -24: "timed out",
    152: "timed out",
    255: "timed out",
}


def outcome_of(exit_code: int | None) -> str:
    """Word what mutmut noted: 0 is a test run that saw nothing, 33 a mutant that no test reaches."""
    return _OF_EXIT_CODE.get(exit_code, "suspicious")


def outcomes(left_behind: Path = LEFT_BEHIND) -> Mapping[str, Mapping[str, str]]:
    """What came of each mutant, by file and by its name."""
    found = {}
    for noted in sorted(left_behind.rglob("*.py.meta")):
        codes = json.loads(noted.read_text(encoding="utf-8"))["exit_code_by_key"]
        if codes:
            file = noted.relative_to(left_behind).with_suffix("").as_posix()
            found[file] = {name: outcome_of(code) for name, code in codes.items()}
    return found


def summary(found: Mapping[str, Mapping[str, str]]) -> str:
    """One row a package, and all of them together."""
    head = [f"| package | mutants | {' | '.join(COLUMNS)} |", "|---" + "|---:" * (len(COLUMNS) + 1) + "|"]
    counts: dict[str, Counter[str]] = {}
    for file, of_file in found.items():
        counts.setdefault("/".join(file.split("/")[:-1][:3]), Counter()).update(of_file.values())
    together = sum(counts.values(), Counter())
    return "\n".join([*head, *(_row(f"`{package}`", of) for package, of in counts.items()), _row("**all**", together)])


def _row(name: str, counts: Counter[str]) -> str:
    return f"| {name} | {counts.total()} | {' | '.join(str(counts[column]) for column in COLUMNS)} |"


def survivors(found: Mapping[str, Mapping[str, str]]) -> Iterator[str]:
    """The mutants that nothing noticed, by mutmut's own names."""
    for of_file in found.values():
        yield from (name for name, outcome in of_file.items() if outcome in {"survived", "suspicious"})


def place_of(name: str) -> str:
    """The function a mutant is in, as a person writes it: ``engine.beam.wire.line_supervisor LineJudge.check 3``."""
    path, _, number = name.partition("__mutmut_")
    module, _, mangled = path.rpartition(".")
    plain = ".".join(mangled.split("ǁ")[1:]) if "ǁ" in mangled else mangled.removeprefix("x_")
    return f"{module} {plain} {number}"


def main(arguments: list[str]) -> int:
    """Print or write the table; name survivors without an explanation."""
    found = outcomes()
    if not found:
        sys.stderr.write("nothing is left behind in mutants/: run `make mutants`\n")
        return 1
    sys.stdout.write(f"{summary(found)}\n")
    if arguments == ["--write"]:
        write_parts(PAGE, {"mutants": lambda: summary(found)})
    explained = EXPLAINED.read_text(encoding="utf-8")
    unexplained = [place_of(name) for name in survivors(found) if f"`{place_of(name)}`" not in explained]
    sys.stdout.writelines(f"not explained in {EXPLAINED.name}: `{place}`\n" for place in unexplained)
    return bool(unexplained)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
