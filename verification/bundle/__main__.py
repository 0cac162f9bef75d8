"""``make bundle KEY=file``: one signed archive with which Tidegate is installed without a network.

``python -m verification.bundle --key FILE [--image FILE] [--out FOLDER]`` writes
``tidegate-VERSION-bundle.tar`` from what is committed. ``--try`` installs it afterwards, as root, in a network
namespace without a network, starts the installed service there, and checks it by ``tidegate smoke``.
"""

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.support.repository import ROOT
from verification.bundle.maker import SIGNER, fetch_debs, fetch_wheels, lay_out, pack, seal
from verification.release.__main__ import build
from verification.release.checks import project_version

MOST_S = 300.0
PORT = "8765"
START_S = 120.0


def main() -> int:
    """Make it, and try it where that was asked for."""
    parser = argparse.ArgumentParser(prog="python -m verification.bundle", description=__doc__)
    parser.add_argument("--key", type=Path, required=True, help="private SSH key that signs; its .pub beside it")
    parser.add_argument("--image", type=Path, help="archive of the image, to be brought along")
    parser.add_argument("--wheels", type=Path, help="folder with the locked wheels; downloaded without")
    parser.add_argument("--no-debs", action="store_true", help="leave the Debian packages out")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--try", action="store_true", dest="is_tried", help="install it without a network")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="tidegate-bundle-") as place:
        archive = _make(asked, Path(place))
        _say(f"{archive}: {archive.stat().st_size // 1_000_000} MB")
        if asked.is_tried:
            _try(archive, asked.key, Path(place) / "machine")
    return 0


def _make(asked: argparse.Namespace, place: Path) -> Path:
    version = project_version(ROOT)
    built, folder = place / "dist", place / f"tidegate-{version}"
    build(built)
    wheels = asked.wheels or place / "wheels"
    if asked.wheels is None:
        fetch_wheels(wheels)
    debs = None if asked.no_debs else place / "debs"
    if debs is not None:
        fetch_debs(debs)
    folder.mkdir()
    lay_out(folder, version=version, own=built.glob("tidegate-*.whl"), wheels=wheels, debs=debs, image=asked.image)
    seal(folder, asked.key)
    archive: Path = asked.out / f"tidegate-{version}-bundle.tar"
    pack(folder, archive)
    return archive


def _try(archive: Path, key: Path, machine: Path) -> None:
    """Install it below a folder of its own, in a namespace whose only interface is loopback."""
    machine.mkdir()
    machine.parent.chmod(0o755)
    signers = machine / "signers"
    signers.write_text(f"{SIGNER} {key.with_name(key.name + '.pub').read_text()}")
    began_s = time.monotonic()
    subprocess.run(["tar", "-xf", str(archive), "-C", str(machine)], check=True)
    (bundle,) = machine.glob("tidegate-*")
    places = {name: str(machine / name) for name in ("root", "data", "settings")}
    options = [part for name, path in places.items() for part in (f"--{name}", path)]
    words = ["sh", str(bundle / "install.sh"), "--allowed-signers", str(signers), *options, "--user", "daemon"]
    subprocess.run(["unshare", "-n", *words, "--no-debs", "--no-service", "--python", _python()], check=True)
    installed_s = time.monotonic() - began_s
    assert installed_s < MOST_S, f"it took {installed_s:.0f} s"
    _say(f"installed without a network in {installed_s:.0f} s")
    _serve(machine, places)
    _say(f"served and checked without a network, {time.monotonic() - began_s:.0f} s in all")


def _python() -> str:
    """Return the interpreter that this environment was made with: it has the version of the wheels."""
    return str(Path(sys._base_executable))  # type: ignore[attr-defined]


def _serve(machine: Path, places: dict[str, str]) -> None:
    program = f"{places['root']}/current/bin/tidegate"
    environment = {
        "PATH": os.environ["PATH"],
        "TIDEGATE_DATA_DIR": str(machine / "served"),
        "TIDEGATE_JOURNAL_DIR": str(machine / "journal"),
        "TIDEGATE_PORT": PORT,
    }
    made = subprocess.run(
        [program, "keys", "create", "smoke", "--scope", "sessions.read", "--days", "1"],
        env=environment,
        cwd=machine,
        capture_output=True,
        text=True,
        check=True,
    )
    key = next(word for word in (made.stdout + made.stderr).split() if word.startswith("tg_") and len(word) > 20)
    script = f"ip link set lo up && exec {program} serve"
    with (machine / "log").open("wb") as log:
        serving = subprocess.Popen(
            ["unshare", "-n", "sh", "-c", script], env=environment, cwd=machine, stdout=log, stderr=log
        )
    try:
        _await_listening(serving, machine / "log")
        smoke = [program, "smoke", f"http://127.0.0.1:{PORT}", "--expect-version", project_version(ROOT)]
        inside = ["nsenter", "-n", "-t", str(serving.pid), *smoke]
        subprocess.run(inside, env={**environment, "TPS_KEY": key}, cwd=machine, check=True)
    finally:
        with contextlib.suppress(ProcessLookupError):
            serving.send_signal(signal.SIGTERM)
        serving.wait(30.0)


def _await_listening(serving: subprocess.Popen[bytes], log: Path) -> None:
    end_s = time.monotonic() + START_S
    while "listening on" not in log.read_text():
        assert serving.poll() is None, log.read_text()
        assert time.monotonic() < end_s, log.read_text()
        time.sleep(0.1)


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - it is what the command is for


if __name__ == "__main__":
    assert shutil.which("ssh-keygen"), "ssh-keygen is missing: apt-get install openssh-client"
    sys.exit(main())
