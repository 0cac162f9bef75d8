"""What runs: the packages of the lock file with their hashes and licences, and the image's Debian packages."""

import re
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution

from tests.support.repository import ROOT

LOCK = ROOT / "requirements.lock"
DOCKERFILE = ROOT / "docker/Dockerfile"
DEBIAN = "bookworm"
_PACKAGE = re.compile(r"(?m)^([A-Za-z0-9._-]+)==([^ \\\n]+)((?:[^\n]*\\\n)*[^\n]*)")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")
_SHORT_NAMES = {
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD": "BSD-3-Clause",
    "BSD License": "BSD-3-Clause",
    "BSD 3-Clause License": "BSD-3-Clause",
    "ISC License": "ISC",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Python Software Foundation License": "PSF-2.0",
}
"""What packages of before licence expressions say, in SPDX's words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One package; ``licence`` is an SPDX expression, None where nothing installed tells it."""

    name: str
    version: str
    sha256: tuple[str, ...]
    licence: str | None

    @property
    def purl(self) -> str:
        """Its name in every list of the kind."""
        return f"pkg:pypi/{self.name.lower().replace('_', '-')}@{self.version}"


def python_parts(lock: str | None = None) -> list[Part]:
    """Read the lock file, by name."""
    text = LOCK.read_text(encoding="utf-8") if lock is None else lock
    return [
        Part(name=name, version=version, sha256=tuple(sorted(_HASH.findall(rest))), licence=licence_of(name, version))
        for name, version, rest in sorted(_PACKAGE.findall(text))
    ]


def debian_parts(dockerfile: str | None = None) -> list[str]:
    """Names of what the image's system stage installs; the image's own bill names all of Debian's, with versions."""
    text = DOCKERFILE.read_text(encoding="utf-8") if dockerfile is None else dockerfile
    stage = text.partition(" AS system\n")[2].partition("\nFROM ")[0].replace("\\\n", " ")
    installed = re.findall(r"apt-get install -y --no-install-recommends ([^&\n]+)", stage)
    return sorted(name for names in installed for name in names.split())


def licence_of(name: str, version: str) -> str | None:
    """Read a package's licence from what is installed; only of the very version."""
    try:
        reported = distribution(name)
    except PackageNotFoundError:
        return None
    if reported.version != version:
        return None
    expression = reported.metadata.get("License-Expression")
    if expression:
        return str(expression)
    lines = str(reported.metadata.get("License") or "").strip().splitlines()
    classifiers = [line for line in reported.metadata.get_all("Classifier") or [] if line.startswith("License ::")]
    words = [lines[0].strip() if len(lines) == 1 else "", *(line.rpartition(" :: ")[2] for line in classifiers)]
    return next((_SHORT_NAMES.get(word, word) for word in words if word), None)
