"""Makes the bundle: the release's wheel, its dependencies, Debian packages, installer, sums, and the signature."""

import hashlib
import platform
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterable
from pathlib import Path

from tests.support.repository import ROOT

NAMESPACE = "tidegate-bundle"
SIGNER = "releases@tidegate"
DEBIAN = ("python3", "python3-venv", "libopenni2-0", "libusb-1.0-0", "openssh-client", "util-linux")
FILES = {
    "docker/bundle/install.sh": "install.sh",
    "docker/bundle/tidegate.service": "tidegate.service",
    "docker/sbom.cdx.json": "sbom.cdx.json",
    "docs/3-operate/it-guide.md": "it-guide.md",
    "requirements.lock": "requirements.lock",
    "LICENSE": "LICENSE",
}


def lay_out(
    folder: Path, *, version: str, own: Iterable[Path], wheels: Path, debs: Path | None, image: Path | None
) -> None:
    """Put everything but sums and signature into an empty folder."""
    for source, name in FILES.items():
        shutil.copy(ROOT / source, folder / name)
    shutil.copytree(ROOT / "docker/room", folder / "room")
    (folder / "VERSION").write_text(version + "\n", encoding="utf-8")
    (folder / "MACHINE").write_text(platform.machine() + "\n", encoding="utf-8")
    for name, sources in {
        "own": own,
        "wheels": wheels.glob("*.whl"),
        "debs": () if debs is None else debs.glob("*.deb"),
        "image": () if image is None else (image,),
    }.items():
        (folder / name).mkdir()
        for source in sources:
            shutil.copy(source, folder / name / source.name)


def seal(folder: Path, key: Path) -> None:
    """Write the sums of all files, and sign them with an SSH key."""
    sums = folder / "SHA256SUMS"
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != sums)
    lines = [f"{_digest(path)}  {path.relative_to(folder)}" for path in files if path.name != "SHA256SUMS.sig"]
    sums.write_text("\n".join(lines) + "\n", encoding="utf-8")
    sums.with_suffix(".sig").unlink(missing_ok=True)
    subprocess.run(["ssh-keygen", "-q", "-Y", "sign", "-f", str(key), "-n", NAMESPACE, str(sums)], check=True)


def pack(folder: Path, archive: Path) -> None:
    """Pack the folder into one file, under its own name; owners are not kept."""
    with tarfile.open(archive, "w") as packed:
        packed.add(folder, folder.name, filter=_without_owner)


def fetch_wheels(out: Path) -> None:
    """Download the locked wheels, each by its hash."""
    out.mkdir(parents=True, exist_ok=True)
    words = ("download", "--quiet", "--require-hashes", "--only-binary", ":all:", "-d", str(out))
    lock = str(ROOT / "requirements.lock")
    subprocess.run([sys.executable, "-m", "pip", *words, "-r", lock], check=True)


def fetch_debs(out: Path) -> None:
    """Download the Debian packages with all that they depend on, as for a machine that has none of them."""
    (out / "partial").mkdir(parents=True, exist_ok=True)
    status = out / "status"
    status.write_text("")
    options = (f"Dir::State::status={status}", f"Dir::Cache::archives={out}", "APT::Sandbox::User=root")
    words = [part for option in options for part in ("-o", option)]
    subprocess.run(
        ["apt-get", *words, "install", "-qq", "-y", "--download-only", "--no-install-recommends", *DEBIAN],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    status.unlink()


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _without_owner(one: tarfile.TarInfo) -> tarfile.TarInfo:
    one.uid = one.gid = 0
    one.uname = one.gname = ""
    return one
