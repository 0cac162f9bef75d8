"""Files that an earlier version wrote, unpacked; tests/data/written_by_92d6c8d/README.md says what they are."""

import hashlib
import shutil
import tarfile
from pathlib import Path

TESTS = next(folder for folder in Path(__file__).parents if folder.name == "tests")
FOLDER = TESTS / "data" / "written_by_92d6c8d"
RELEASES = TESTS / "data" / "releases"
"""A data folder of each release, packed by `make release`."""
TAPE = FOLDER / "scripted.tape"
LEARNING, RESUMED, KILLED = (
    "94ad93b891924c52acecbd0097aba2b3",
    "96c2e41fca0e41a68677316c7ddc4718",
    "07288b4798694b468e417bb53ba8a520",
)
"""The sessions: one that learned its model, one that began with that model, and one whose process was killed."""


def unpacked(archive: str, out: Path) -> Path:
    """Unpack an archive into a folder, and return the folder."""
    with tarfile.open(FOLDER / archive) as packed:
        packed.extractall(out, filter="data")
    return out


def released() -> list[str]:
    """Return the versions whose data folder is kept, oldest first."""
    found = [path.name.removesuffix(".tar.xz") for path in RELEASES.glob("*.tar.xz")]
    return sorted(found, key=lambda version: tuple(map(int, version.split("."))))


def data_of(version: str, out: Path) -> Path:
    """Unpack a release's data folder, and return it."""
    with tarfile.open(RELEASES / f"{version}.tar.xz") as packed:
        packed.extractall(out, filter="data")
    return out / "data"


def copied(folders: Path, name: str, out: Path) -> Path:
    """Copy one of the data folders, to write in; a killed one's journal follows it under its new name."""
    data = Path(shutil.copytree(folders / name, out / "data"))
    data.chmod(0o700)
    (out / "journals").mkdir(mode=0o700)
    for journal in (folders / name).parent.glob("journals/*.journal"):
        _, _, session = journal.name.split("-")
        digest = hashlib.sha256(str(data.resolve()).encode()).hexdigest()[:16]
        shutil.copy(journal, out / "journals" / f"tidegate-{digest}-{session}")
    return data
