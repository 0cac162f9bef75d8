"""``python -m tests.support.size [COMMIT ...]``: how large the repository is; one column for each commit, HEAD last."""

import ast
import json
import re
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping

from tests.support.repository import ROOT

PRODUCT = re.compile(r"^(engine|service|migrations)/.*\.py$")
TESTS = re.compile(r"^tests/.*\.py$")
WORDS = re.compile(r"^(README\.md|CHANGELOG\.md|docs/.*\.md)$")
OPENAPI = "openapi/openapi.json"
COMPILED = re.compile(r"^engine/.*\.[ch]$")
PAGE = re.compile(r"^service/web/dashboard/(?!vendor/).*\.(js|css|html)$")


def git(*words: str) -> bytes:
    """Return what git prints."""
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True).stdout


def files_of(commit: str) -> dict[str, bytes]:
    """Return the contents of all files of a commit by path."""
    listed = [line.split(maxsplit=3) for line in git("ls-tree", "-r", "-z", commit).decode().split("\0") if line]
    paths = {path: blob for _, kind, blob, path in listed if kind == "blob"}
    request = "\n".join(paths.values()).encode() + b"\n"
    command = ["git", "cat-file", "--batch"]
    found = subprocess.run(command, cwd=ROOT, input=request, check=True, capture_output=True).stdout
    contents, at = {}, 0
    for path in paths:
        end = found.index(b"\n", at)
        size = int(found[at:end].split()[2])
        contents[path] = found[end + 1 : end + 1 + size]
        at = end + 2 + size
    return contents


def lines(kind: re.Pattern[str]) -> Callable[[Mapping[str, bytes]], str]:
    """Return a measure: lines of the files whose path matches."""
    return lambda files: f"{sum(text.count(bytes([10])) for path, text in files.items() if kind.match(path)):,}"


def words(files: Mapping[str, bytes]) -> str:
    """Count the words of README, changelog and documents."""
    return f"{sum(len(text.split()) for path, text in files.items() if WORDS.match(path)):,}"


def overrides(files: Mapping[str, bytes]) -> str:
    """Count the settings that an environment variable can give; all of them before there was a file."""
    groups = [text.decode() for path, text in files.items() if path.startswith("service/core/settings/")]
    if not any("place_of" in text for text in groups):
        return "all"
    listed = [
        found[1] for text in groups if (found := re.search(r"OVERRIDES = frozenset\(\s*\{(.*?)\}", text, re.DOTALL))
    ]
    return str(sum(len(re.findall(r'"\w+"', text)) for text in listed) or sum(text.count("Env[") for text in groups))


def operations(files: Mapping[str, bytes]) -> str:
    """Count the operations of the HTTP API."""
    paths = json.loads(files[OPENAPI])["paths"]
    return str(sum(len(operations) for operations in paths.values()))


def modules(files: Mapping[str, bytes]) -> str:
    """Count the product's modules without packages' own, with the median of their lines."""
    kind = re.compile(r"^(engine|service)/.*(?<!__init__)\.py$")
    lengths = [text.count(b"\n") for path, text in files.items() if kind.match(path)]
    return f"{len(lengths)}, {statistics.median(lengths):.0f}"


def imported(files: Mapping[str, bytes]) -> str:
    """Count the engine's modules that the service imports."""
    found = set()
    for path, text in files.items():
        if path.startswith("service/") and path.endswith(".py"):
            found |= set(re.findall(rb"^\s*from (engine\.[\w.]+) import", text, re.MULTILINE))
    return str(len(found))


def walked(walk: str) -> Callable[[Mapping[str, bytes]], str]:
    """Return a measure: the distinct files of a walk of the architecture page."""
    block = re.compile(rf"<!-- (walk|helpers): {walk} -->\n(.*?)<!-- end -->", re.DOTALL)

    def count(files: Mapping[str, bytes]) -> str:
        found: dict[str, set[str]] = {"walk": set(), "helpers": set()}
        for kind, text in block.findall(files["docs/1-start/architecture.md"].decode()):
            found[kind] |= set(re.findall(r"^\d+\. `([\w/]+\.py)`", text, re.MULTILINE))
            for folder, names in re.findall(r"^- `([\w/]+/)`: (.+)$", text, re.MULTILINE):
                found[kind] |= {folder + name for name in re.findall(r"`(\w+\.py)`", names)}
        helpers = len(found["helpers"] - found["walk"])
        return f"{len(found['walk'])}" + (f", with helpers {len(found['walk']) + helpers}" if helpers else "")

    return count


def large_classes(files: Mapping[str, bytes]) -> str:
    """Name the engine's classes with more than 20 methods."""
    found = []
    for path, text in files.items():
        if path.startswith("engine/") and path.endswith(".py"):
            classes = [one for one in ast.walk(ast.parse(text)) if isinstance(one, ast.ClassDef)]
            counted = [(one.name, sum(isinstance(part, ast.FunctionDef) for part in one.body)) for one in classes]
            found += [f"{name} {count}" for name, count in counted if count > 20]
    return ", ".join(sorted(found)) or "none"


ROWS: dict[str, Callable[[Mapping[str, bytes]], str]] = {
    "product, Python lines": lines(PRODUCT),
    "product, lines of C": lines(COMPILED),
    "product modules, median lines": modules,
    "engine modules that the service imports": imported,
    "files that decide or forward, a frame": walked("a frame"),
    "files that decide or forward, an arm call": walked("an arm call"),
    "engine classes over 20 methods": large_classes,
    "page, lines": lines(PAGE),
    "tests, Python lines": lines(TESTS),
    "settings as environment variables": overrides,
    "HTTP operations": operations,
    "openapi.json, kB": lambda files: f"{len(files[OPENAPI]) / 1e3:.0f}",
    "README, CHANGELOG, docs, words": words,
    "repository without history, MB": lambda files: f"{sum(map(len, files.values())) / 1e6:.1f}",
}


def main() -> None:
    """Print the table."""
    commits = [*sys.argv[1:], "HEAD"]
    found = [files_of(commit) for commit in commits]
    names = [git("rev-parse", "--short", commit).decode().strip() for commit in commits]
    rows = [("", *names), *((name, *map(measure, found)) for name, measure in ROWS.items())]
    widths = [max(len(row[number]) for row in rows) for number in range(len(rows[0]))]
    for row in rows:
        sys.stdout.write("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() + "\n")


if __name__ == "__main__":
    main()
