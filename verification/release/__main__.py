"""``make release``: refuse what is not ready, build wheel and source archive, keep a data folder.

Writes into ``dist/``: the wheel, the source archive, the bill of materials, SHA256SUMS. The release's data folder goes
to tests/data/releases/VERSION.tar.xz where it is not there yet: commit it, then run once more. Tags and publishes
nothing.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from types import SimpleNamespace

from lab.simulated_tps.prescription import built_in_plan
from tests.support.phantom_recordings import volunteer
from tests.support.planning.treatment_services import PASSWORD, THERAPIST, treating
from tests.support.releases import RELEASES
from tests.support.repository import ROOT
from verification.release.checks import project_version, troubles

SERVE = ("service.cli", "serve", "--port", "{port}", "--data", "{data}", "--recordings", "{recordings}")
PATIENT = {
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_LEASE_MS": "200",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_MAX_GAP_MS": "200",
}


def main() -> int:
    """Do all of it; exit code 1 where something stands against the release."""
    parser = argparse.ArgumentParser(prog="python -m verification.release", description=__doc__)
    parser.add_argument("--check", action="store_true", help="only say what stands against a release")
    parser.add_argument("--data-folder", type=Path, help="only write the archive of a data folder here")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    asked = parser.parse_args()
    if asked.data_folder is not None:
        keep_data_folder(asked.data_folder)
        return 0
    found = list(troubles(ROOT))
    for one in found:
        _say(f"not ready: {one}")
    if found or asked.check:
        return int(bool(found))
    version = project_version(ROOT)
    kept = RELEASES / f"{version}.tar.xz"
    if not kept.exists():
        kept.parent.mkdir(exist_ok=True)
        keep_data_folder(kept)
        _say(f"{kept.relative_to(ROOT)}: commit it, then run once more")
        return 1
    build(asked.out)
    _say(f"then: git tag -a v{version}; make docker-test")
    return 0


def build(out: Path) -> None:
    """Build the wheels and the source archive from what is committed, and list them."""
    out.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        tree = Path(place) / "tree"
        archive = Path(place) / "tree.tar"
        subprocess.run(["git", "archive", "-o", str(archive), "HEAD"], cwd=ROOT, check=True)
        with tarfile.open(archive) as packed:
            packed.extractall(tree, filter="data")
        for kind, folder in (("sdist", tree), ("wheel", tree), ("wheel", tree / "lab")):
            code = f"import setuptools.build_meta as b, sys; b.build_{kind}(sys.argv[1])"
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            subprocess.run([sys.executable, "-c", code, str(out.resolve())], cwd=folder, check=True, **quiet)
    shutil.copy(ROOT / "docker/sbom.cdx.json", out / "sbom.cdx.json")
    files = sorted(path for path in out.iterdir() if path.name != "SHA256SUMS")
    kinds = sorted(path.suffix for path in files)
    expected = [".gz", ".json", ".whl", ".whl"]
    assert kinds == expected, f"{out} must hold one source archive, two wheels and the bill: {kinds}"
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in files]
    (out / "SHA256SUMS").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for path in files:
        _say(f"{path.name}: {path.stat().st_size // 1024} kB")


def keep_data_folder(archive: Path) -> None:
    """Deliver a fraction of a virtual volunteer, and pack the data folder that it leaves."""
    with tempfile.TemporaryDirectory() as place:
        places = SimpleNamespace(mktemp=lambda _: Path(tempfile.mkdtemp(dir=place)))
        folder = volunteer(places, "occlusion", volunteer=1, seconds=36.0, seed=1)
        with treating(folder, *SERVE, has_therapist=True, **PATIENT) as room:
            plan = folder / "plan.dcm"
            plan.write_bytes(built_in_plan(uid="1.2.826.0.1.3680043.8.498.1.8", beams=(("AP", 8.0),)))
            given = {
                "--url": room.url,
                "--plan": str(plan),
                "--recording": "recording.oni",
                "--calibration": str(folder / "calibration.json"),
                "--lower-mm": "-3",
                "--upper-mm": "6",
                "--acknowledge-as": THERAPIST,
                "--out": str(folder / "out"),
            }
            words = [sys.executable, "-m", "service.cli", "simulate-tps"]
            subprocess.run(
                [*words, *(part for pair in given.items() for part in pair)],
                env={**os.environ, **room.environment, "TPS_KEY": room.key, "TPS_PASSWORD": PASSWORD},
                cwd=ROOT,
                check=True,
                stdout=subprocess.DEVNULL,
            )
            room.process.terminate()
            room.process.wait(20.0)
        with tarfile.open(archive, "w:xz") as packed:
            packed.add(folder / "data", "data", filter=_anonymous)
    _say(f"{archive}: {archive.stat().st_size // 1024} kB")


def _anonymous(one: tarfile.TarInfo) -> tarfile.TarInfo:
    one.uid = one.gid = 0
    one.uname = one.gname = ""
    return one


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - it is what the command is for


if __name__ == "__main__":
    sys.exit(main())
