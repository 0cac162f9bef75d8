"""What must be true before a release: one version, a clean tree, a changelog, a kept contract, figures of this code."""

import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

from tests.support.documents.figures import stale

VERSION = re.compile(r"\d+\.\d+\.\d+")


def troubles(root: Path) -> Iterator[str]:
    """Yield a sentence for each thing that stands against a release of the checkout in ``root``."""
    version = project_version(root)
    if VERSION.fullmatch(version) is None:
        yield f"pyproject.toml: version {version!r} must be MAJOR.MINOR.PATCH"
    yield from _other_versions(root, version)
    yield from _changelog(root, version)
    yield from _contract(root, version)
    if (trouble := stale(root)) is not None:
        yield trouble
    yield from _git(root, version)


def project_version(root: Path) -> str:
    """Read the version that every other place must have."""
    return str(tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"])


def _other_versions(root: Path, version: str) -> Iterator[str]:
    places = {
        "lab/pyproject.toml": r'(?ms)^version = "([^"]+)"$.*"tidegate==\1"',
        "engine/__init__.py": r'(?m)^__version__ = "([^"]+)"$',
        "openapi/openapi.json": r'"version": "([^"]+)"',
        "docker/sbom.cdx.json": r'"bom-ref": "pkg:generic/tidegate@([^"]+)"',
    }
    for name, pattern in places.items():
        found = re.search(pattern, (root / name).read_text(encoding="utf-8"))
        if found is None or found[1] != version:
            yield f"{name}: version {found[1] if found else 'missing'} must be {version}, as in pyproject.toml"


def _changelog(root: Path, version: str) -> Iterator[str]:
    text = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"(?m)^## \[([^\]]+)\](?: - (\d{4}-\d\d-\d\d))?$", text)
    if not sections or sections[0][0] != "Unreleased":
        yield "CHANGELOG.md: the first section must be [Unreleased]"
        return
    if text.partition("## [Unreleased]")[2].partition("\n## ")[0].strip():
        yield "CHANGELOG.md: [Unreleased] has entries: move them under the release"
    if len(sections) < 2 or sections[1][0] != version or not sections[1][1]:
        yield f"CHANGELOG.md: the second section must be [{version}] - YYYY-MM-DD"


def _contract(root: Path, version: str) -> Iterator[str]:
    kept, now = root / f"openapi/released/{version}.json", root / "openapi/openapi.json"
    if not kept.exists() or kept.read_bytes() != now.read_bytes():
        yield f"openapi/released/{version}.json must be a copy of openapi/openapi.json"


def _git(root: Path, version: str) -> Iterator[str]:
    if _said(root, "status", "--porcelain"):
        yield "git: there are changes that are not committed"
    tags = _said(root, "tag", "--points-at", "HEAD").split()
    if f"v{version}" not in tags and _said(root, "tag", "--list", f"v{version}"):
        yield f"git: the tag v{version} is on another commit: raise the version"
    for tag in tags:
        if tag.startswith("v") and tag != f"v{version}":
            yield f"git: this commit is tagged {tag}, the version is {version}"


def _said(root: Path, *words: str) -> str:
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()
