"""The data folders of releases: one archive each, packed by `make release`; compatibility begins with 1.0.0."""

import tarfile
from pathlib import Path

TESTS = next(folder for folder in Path(__file__).parents if folder.name == "tests")
RELEASES = TESTS / "data" / "releases"


def released() -> list[str]:
    """Return the versions whose data folder is kept, oldest first."""
    found = [path.name.removesuffix(".tar.xz") for path in RELEASES.glob("*.tar.xz")]
    return sorted(found, key=lambda version: tuple(map(int, version.split("."))))


def data_of(version: str, out: Path) -> Path:
    """Unpack a release's data folder, and return it."""
    with tarfile.open(RELEASES / f"{version}.tar.xz") as packed:
        packed.extractall(out, filter="data")
    return out / "data"
