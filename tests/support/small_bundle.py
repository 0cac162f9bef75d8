"""Bundles with a program of a few lines instead of Tidegate: signed as the real ones, installed in seconds."""

import subprocess
import zipfile
from dataclasses import dataclass
from pathlib import Path

from verification.bundle.maker import SIGNER, lay_out, seal

PROGRAM = '''"""Records its arguments; fails where a file says so."""
import os, pathlib, sys, tomllib

HERE = pathlib.Path(os.environ["TIDEGATE_DATA_DIR"])

def main():
    words = sys.argv[1:]
    name = tomllib.loads(pathlib.Path(os.environ["TIDEGATE_CONFIG"]).read_text())["site"]["machine_name"]
    with (HERE / "calls").open("a") as calls:
        print("VERSION", os.getuid(), name, *words, file=calls)
    sys.exit(1 if (HERE / f"fail-{words[0]}").exists() else 0)
'''
TITLES = 'def titles():\n    return {"0001": "first", "REVISION": "newest"}\n'


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """A key that signs, and the file with its public half as an installer gets it."""

    private: Path
    signers: Path


def make_key(folder: Path, name: str = "release") -> Key:
    """Make a signing key; its signers file lies beside it."""
    private, signers = folder / name, folder / f"{name}.signers"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "test", "-f", str(private)], check=True)
    signers.write_text(f"{SIGNER} {private.with_name(name + '.pub').read_text()}")
    return Key(private=private, signers=signers)


def make_bundle(place: Path, key: Key, *, version: str = "1.0.0", revision: str = "0002") -> Path:
    """Lay out and sign a bundle of the small program."""
    own, wheels, folder = place / f"own-{version}", place / "wheels", place / f"tidegate-{version}"
    for one in (own, folder):
        one.mkdir(parents=True)
    wheels.mkdir(exist_ok=True)
    wheel = _wheel(own, version, revision)
    lay_out(folder, version=version, own=(wheel,), wheels=wheels, debs=None, image=None)
    (folder / "requirements.lock").write_text("# none\n")
    seal(folder, key.private)
    return folder


def _wheel(folder: Path, version: str, revision: str) -> Path:
    path, info = folder / f"tidegate-{version}-py3-none-any.whl", f"tidegate-{version}.dist-info"
    files = {
        "small_program.py": PROGRAM.replace("VERSION", version),
        "service/__init__.py": "",
        "service/storage/__init__.py": "",
        "service/storage/database/__init__.py": "",
        "service/storage/database/migrations.py": TITLES.replace("REVISION", revision),
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: tidegate\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "[console_scripts]\ntidegate = small_program:main\n",
    }
    with zipfile.ZipFile(path, "w") as packed:
        for name, content in files.items():
            packed.writestr(name, content)
        packed.writestr(f"{info}/RECORD", "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD")))
    return path
