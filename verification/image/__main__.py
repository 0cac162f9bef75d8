"""``make docker-test``: the image is built, looked at, run, killed, upgraded, rolled back and restored elsewhere.

``python -m verification.image [--image NAME] [--base BASE] [--ca-bundle FILE] [--out FILE]``. Each step is printed
with its time and figures; exit code 1 at the first that fails. With ``--image`` an image that is there is tested.
"""

import argparse
import contextlib
import json
import os
import platform
import signal
import sqlite3
import ssl
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from engine import __version__
from service.client import TidegateClient
from tests.support.access.tls_certificate import make_certificate
from tests.support.phantom_recordings import volunteer
from tests.support.planning.treatment_services import SCOPES
from tests.support.releases import RELEASES
from tests.support.repository import ROOT
from tests.support.service.processes import free_port
from verification.image.container import ADDRESS, Container, Image, mounted, network, new_folder, run
from verification.supply.sbom import trouble_with

LARGEST_MB = 700
READY_S = 5.0
START_S = 90.0
PORT = 8443
THERAPIST, PASSWORD = "A. Therapist", "a long enough password"
SETTINGS = {
    "TIDEGATE_PORT": str(PORT),
    "TIDEGATE_TLS_CERT": "/tls/cert.pem",
    "TIDEGATE_TLS_KEY": "/tls/key.pem",
    "TIDEGATE_ALLOWED_HOSTS": f"gating.example,{ADDRESS}",
    # A test's machine is shared: what is tested here is the way through, not the time it takes.
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_LEASE_MS": "200",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_MAX_GAP_MS": "200",
}
CHECK = ("/opt/tidegate/bin/tidegate-health", "--restart-after", "3")
SHELLS = ("bin/sh", "bin/bash", "usr/bin/apt-get", "usr/bin/dpkg", "usr/bin/perl", "opt/tidegate/bin/pip")


class StepError(Exception):
    """A step found what must not be."""


def require(is_so: object, what: str) -> None:
    """Fail the step with a sentence."""
    if not is_so:
        raise StepError(what)


class Bench:
    """The image, a place for folders, and what each step found."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.found: list[dict[str, Any]] = []
        self.image: Image
        self.tls = place / "tls"
        self.tls.mkdir()
        make_certificate(self.tls, addresses=(ADDRESS,))
        for file in self.tls.iterdir():
            file.chmod(0o644)
        place.chmod(0o755)

    def step(self, name: str, do: Callable[[], dict[str, object]]) -> None:
        """Do one step, and print what it took and found."""
        began_s = time.monotonic()
        try:
            figures = do()
        except (StepError, RuntimeError, OSError, AssertionError, KeyError) as error:
            _say(f"FAILED  {name}: {error}")
            self.found.append({"step": name, "failed": str(error)})
            raise SystemExit(1) from error
        took_s = round(time.monotonic() - began_s, 1)
        self.found.append({"step": name, "seconds": took_s, **figures})
        _say(f"{took_s:6.1f} s  {name}: " + ", ".join(f"{key} {value}" for key, value in figures.items()))

    def container(self, data: Path, **settings: str) -> Container:
        """Make a container on a data folder, with TLS."""
        return Container(
            image=self.image,
            data=data,
            log=self.place / f"{data.name}.log",
            folders={"/tls": self.tls, "/backup": self.place / "backup"},
            settings={**SETTINGS, **settings},
        )

    def client(self, key: str) -> TidegateClient:
        """Open a client from outside."""
        return TidegateClient(f"https://{ADDRESS}:{PORT}", key=key, ca_file=self.tls / "cert.pem", operator=THERAPIST)


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - it is what the command is for


def build(name: str, base: str | None, ca_bundle: Path | None) -> dict[str, object]:
    """Build the image as docs/3-operate/image.md says, from what is committed."""
    revision = run("git", "rev-parse", "HEAD", cwd=ROOT).strip()
    given = {"VERSION": __version__, "REVISION": revision, "CREATED": datetime.now(UTC).isoformat(timespec="seconds")}
    given |= {} if base is None else {"BASE": base}
    words = [part for key, value in given.items() for part in ("--build-arg", f"{key}={value}")]
    words += [] if ca_bundle is None else ["--secret", f"id=ca_bundle,src={ca_bundle}"]
    with tempfile.TemporaryDirectory() as checkout:
        archive = Path(checkout) / "checkout.tar"
        run("git", "archive", "-o", archive, "HEAD", cwd=ROOT)
        with tarfile.open(archive) as packed:
            packed.extractall(Path(checkout) / "tree", filter="data")
        isolation = ("--isolation", "chroot", "--network", "host", "--format", "docker", "--layers")
        run(
            "buildah",
            "bud",
            *isolation,
            *words,
            "-f",
            "docker/Dockerfile",
            "-t",
            name,
            ".",
            cwd=Path(checkout) / "tree",
        )
    return {"revision": revision[:12]}


def look(bench: Bench) -> dict[str, object]:
    """Check what the image holds and what its configuration says."""
    image, root = bench.image, bench.image.root
    labels = image.config["Labels"]
    require(labels["org.opencontainers.image.version"] == __version__, "the version's label is another")
    require(len(labels["org.opencontainers.image.revision"]) == 40, "no revision")
    require(labels["org.opencontainers.image.created"], "no time of making")
    require(image.config["User"] == "10001:10001", "it runs as another user")
    require(image.config.get("Healthcheck", {}).get("Test") == ["CMD", "tidegate-health"], "the health check is lost")
    require(image.size_mb <= LARGEST_MB, f"{image.size_mb} MB are more than {LARGEST_MB}")
    require(not [*root.glob("opt/tidegate/lib/*/site-packages/lab")], "the lab is in it")
    special = [
        path for path in root.rglob("*") if not path.is_symlink() and path.is_file() and path.stat().st_mode & 0o6000
    ]
    require(not special, f"setuid: {special}")
    require(not [name for name in SHELLS if (root / name).exists()], "a shell or a package manager is left")
    commands = sorted(path.name for path in (root / "opt/tidegate/bin").iterdir())
    require(
        set(commands) == {"python", "python3", "python3.11", "tidegate", "tidegate-health"}, f"commands: {commands}"
    )
    bill = (root / "usr/share/doc/tidegate/sbom.cdx.json").read_text()
    require(trouble_with(bill) is None, "the bill of materials is no CycloneDX")
    parts = json.loads(bill)["components"]
    debian = [part for part in parts if part["purl"].startswith("pkg:deb/")]
    require(debian and all("version" in part for part in debian), "Debian packages without versions")
    return {"MB": image.size_mb, "components": len(parts), "of Debian": len(debian)}


def await_ready(url: str, key: str, trusted: ssl.SSLContext | None, check: Callable[[], None]) -> None:
    """Wait until a session could begin, asked ten times a second; ``check`` fails where that can no longer be."""
    asked = urllib.request.Request(f"{url}/readyz", headers={"Authorization": f"Bearer {key}"})
    end_s = time.monotonic() + START_S
    while True:
        check()
        require(time.monotonic() < end_s, f"not ready in {START_S:g} s")
        with (
            contextlib.suppress(urllib.error.URLError, ConnectionError, TimeoutError),
            urllib.request.urlopen(asked, timeout=5.0, context=trusted),
        ):
            return
        time.sleep(0.1)


def _require_running(process: subprocess.Popen[bytes], log: Path) -> None:
    require(process.poll() is None, log.read_text()[-3000:])


def started(bench: Bench, container: Container, key: str) -> dict[str, object]:
    """Start a container and wait until it is ready, asked from outside."""
    process = container.start().process
    assert process is not None
    trusted = ssl.create_default_context(cafile=bench.tls / "cert.pem")
    check = partial(_require_running, process, container.log)
    await_ready(f"https://{ADDRESS}:{PORT}", key, trusted, check)
    ready_s = time.monotonic() - container.started_s
    with urllib.request.urlopen(f"https://{ADDRESS}:{PORT}/docs/", timeout=5.0, context=trusted) as page:
        require(b"<h1>Documentation" in page.read(), "the documentation is not served")
    load = os.getloadavg()[0]
    note = "" if ready_s <= READY_S else f" (more than {READY_S:g} s; load average {load:.1f})"
    return {"ready after": f"{ready_s:.1f} s{note}", "processor": f"{container.processor_s():.1f} s"}


def first_start(bench: Bench, container: Container) -> tuple[dict[str, object], str]:
    """Make a key and a therapist by commands, and start; return the figures and the key."""
    scopes = [part for scope in (*SCOPES, "metrics.read") for part in ("--scope", str(scope))]
    told = container.command("keys", "create", "tps", *scopes, "--days", "2")
    key = next(word for word in told.split() if word.startswith("tg_") and len(word) > 20)
    container.command("users", "add", THERAPIST, "--role", "therapist", "--password-stdin", text=PASSWORD + "\n")
    version = container.command("--version").strip()
    require("compiled" in version, f"the compiled frame path does not run: {version}")
    return {"version": version, **started(bench, container, key)}, key


def health(container: Container) -> dict[str, object]:
    """The health check follows port, TLS and allowed hosts, from inside; the root is read-only."""
    done = container.execute(*CHECK)
    require(done.returncode == 0, f"unhealthy: {done.stdout}{done.stderr}")
    writes = container.execute("/opt/tidegate/bin/python", "-c", "open('/opt/x', 'w')")
    require("Read-only file system" in writes.stderr, f"the root can be written: {writes.stderr}")
    return {"says": "healthy", "root": "read-only"}


def hang(bench: Bench, container: Container, key: str) -> dict[str, object]:
    """Freeze the service: the health check kills it, and an engine that restarts what has ended starts it again."""
    container.stop()
    container.has_init = True
    again = started(bench, container, key)
    require(container.execute(*CHECK).returncode == 0, "unhealthy behind an init")
    (frozen,) = [pid for pid in container.pids() if pid != container.pid and _is_service(pid)]
    os.kill(frozen, signal.SIGSTOP)
    said = [container.execute(*CHECK).stdout for _ in range(3)]
    require("killed the service" in said[-1], f"not killed: {said}")
    assert container.process is not None
    code = container.process.wait(20)
    container.has_init = False
    started(bench, container, key)
    return {"killed after": "3 failures", "the container ended with": code, **again}


def _is_service(pid: int) -> bool:
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    return b"python" in words[0] and b"serve" in words


def fraction(bench: Bench, key: str, **options: str) -> subprocess.Popen[str]:
    """Begin a whole fraction from outside, as planning software does."""
    recording = bench.place / "volunteer"
    given = {
        "--url": f"https://{ADDRESS}:{PORT}",
        "--ca-file": str(bench.tls / "cert.pem"),
        "--recording": "volunteer/recording.oni",
        "--calibration": str(recording / "calibration.json"),
        "--lower-mm": "-3",
        "--upper-mm": "6",
        "--beam-seconds": "0.8",
        "--acknowledge-as": THERAPIST,
        "--out": str(bench.place / f"report{time.monotonic_ns()}"),
        **options,
    }
    return subprocess.Popen(
        [sys.executable, "-m", "service.cli", "simulate-tps", *(part for pair in given.items() for part in pair)],
        env={**os.environ, "TPS_KEY": key, "TPS_PASSWORD": PASSWORD},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def whole_session(bench: Bench, container: Container, key: str) -> dict[str, object]:
    """Deliver a fraction over TLS from outside."""
    process = fraction(bench, key)
    said = process.communicate(timeout=300)[0]
    require(process.returncode == 0 and "all checks passed" in said, said[-3000:])
    with bench.client(key) as tidegate:
        (session,) = tidegate.sessions()
        transitions = list(tidegate.transitions(session["id"]))
        require(tidegate.verify_audit()["is_intact"], "the audit is broken")
    return {"transitions": len(transitions), "processor so far": f"{container.processor_s():.0f} s"}


def _said_by(process: subprocess.Popen[str]) -> str:
    return process.communicate()[0][-2000:] if process.poll() is not None else "it runs"


def killed(bench: Bench, container: Container, key: str) -> dict[str, object]:
    """Kill the service while the beam is on; the next start finds everything."""
    process = fraction(bench, key, **{"--beam-seconds": "60", "--first": "2"})
    with bench.client(key) as tidegate:
        end_s = time.monotonic() + 120
        before = {one["id"] for one in tidegate.sessions()}
        session_id = ""
        while time.monotonic() < end_s:
            require(process.poll() is None, "the planning system ended: " + _said_by(process))
            new = [one["id"] for one in tidegate.sessions() if one["id"] not in before]
            if new and tidegate.read_session(new[0])["status"] == "running":
                session_id = new[0]
                if "beam_on" in {one["to_state"] for one in tidegate.transitions(session_id)}:
                    break
            time.sleep(0.1)
        require(session_id, "no session began")
        seen = len(list(tidegate.transitions(session_id)))
    pids = container.pids()
    container.kill()
    process.kill()
    process.communicate()
    left = [pid for pid in pids if Path(f"/proc/{pid}").exists()]
    require(not left, f"processes are left: {left}")
    again = started(bench, container, key)
    with bench.client(key) as tidegate:
        session = tidegate.read_session(session_id)
        kept = list(tidegate.transitions(session_id))
        samples = tidegate.export_samples(session_id, bench.place / "killed.arrow")
        intact = tidegate.verify_audit()["is_intact"]
        require(session["status"] == "interrupted", f"the session is {session['status']}")
        require(len(kept) >= seen > 0, f"{len(kept)} of {seen} transitions")
        require(intact, "the audit is broken")
        require(len(list(tidegate.sessions())) == 2, "a session is lost")
    return {"transitions": f"{len(kept)} ({seen} seen before)", "samples": f"{samples.size // 1024} kB", **again}


def backed_up(bench: Bench, container: Container, key: str) -> dict[str, object]:
    """Back up the running service, restore elsewhere, and find the same there."""
    _inside(container, "backup", "/backup/all.backup")
    file = bench.place / "backup" / "all.backup"
    with bench.client(key) as tidegate:
        before = sorted(one["id"] for one in tidegate.sessions())
        rows = tidegate.verify_audit()["rows"]
    stopped_s = container.stop()
    elsewhere = bench.container(new_folder(bench.place / "elsewhere"))
    elsewhere.command("restore", "/backup/all.backup")
    again = started(bench, elsewhere, key)
    with bench.client(key) as tidegate:
        require(sorted(one["id"] for one in tidegate.sessions()) == before, "other sessions than before")
        found = tidegate.verify_audit()
        require(found["is_intact"] and found["rows"] >= rows, "the audit is not what it was")
    elsewhere.stop()
    return {"backup": f"{file.stat().st_size // 1024} kB", "stop": f"{stopped_s:.1f} s", **again}


def _inside(container: Container, *command: str) -> str:
    done = container.execute("/opt/tidegate/bin/tidegate", *command)
    require(done.returncode == 0, done.stdout + done.stderr)
    return done.stdout + done.stderr


def newest_release() -> Path | None:
    """Return the data folder of the release before this version; None without one."""
    kept = {_version(path.name.removesuffix(".tar.xz")): path for path in RELEASES.glob("*.tar.xz")}
    earlier = [version for version in kept if version < _version(__version__)]
    return kept[max(earlier)] if earlier else None


def _version(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(".")))


def revision_of(data: Path) -> str:
    """Read the schema's revision from a database file."""
    with contextlib.closing(sqlite3.connect(f"file:{data / 'tidegate.db'}?mode=ro", uri=True)) as db:
        return str(db.execute("SELECT version_num FROM alembic_version").fetchone()[0])


def upgraded(bench: Bench, release: Path) -> tuple[dict[str, object], Container, str, str]:
    """Start on the data folder of an earlier version: its tables are upgraded, its content is there."""
    folders = bench.place / "earlier"
    folders.mkdir()
    with tarfile.open(release) as packed:
        packed.extractall(folders, filter="data")
    container = bench.container(new_folder(bench.place / "upgraded", folders / "data"))
    before = revision_of(container.data)
    scopes = [part for scope in SCOPES for part in ("--scope", str(scope))]
    told = container.command("keys", "create", "after the upgrade", *scopes, "--days", "2")
    copy = container.data / f"tidegate-before-upgrade-from-{before}.db"
    require(revision_of(container.data) > before and copy.exists(), f"not upgraded, or no copy kept: {told}")
    key = next(word for word in told.split() if word.startswith("tg_") and len(word) > 20)
    again = started(bench, container, key)
    with bench.client(key) as tidegate:
        sessions = list(tidegate.sessions())
        intact = tidegate.verify_audit()["is_intact"]
        size = sum(tidegate.export_samples(one["id"], bench.place / f"{one['id']}.arrow").size for one in sessions)
    require(sessions and intact, "sessions or audit are lost")
    container.stop()
    figures = {
        "from": before,
        "to": revision_of(container.data),
        "sessions": len(sessions),
        "samples": f"{size // 1024} kB",
    }
    return {**figures, **again}, container, before, key


def rolled_back(bench: Bench, release: Path, container: Container, before: str, key: str) -> dict[str, object]:
    """Go back: the newer program downgrades, and the older program serves what that left, sessions and audit."""
    told = container.command("database", "downgrade", before, "--force").strip()
    require(revision_of(container.data) == before, "another revision")
    commit = f"v{release.name.removesuffix('.tar.xz')}"
    tree, archive, port = bench.place / "older", bench.place / "older.tar", free_port()
    run("git", "archive", "-o", archive, commit, cwd=ROOT)
    with tarfile.open(archive) as packed:
        packed.extractall(tree, filter="data")
    words = [sys.executable, "-m", "service.cli", "serve", "--port", str(port), "--data", str(container.data)]
    environment = {**os.environ, "PYTHONPATH": str(tree), "TIDEGATE_JOURNAL_DIR": str(container.data / "journal")}
    with (bench.place / "older.log").open("wb") as log:
        older = subprocess.Popen(words, cwd=tree, env=environment, stdout=log, stderr=log)
    try:
        await_ready(f"http://127.0.0.1:{port}", key, None, partial(_require_running, older, bench.place / "older.log"))
        with TidegateClient(f"http://127.0.0.1:{port}", key=key) as tidegate:
            sessions, audit = len(list(tidegate.sessions())), tidegate.verify_audit()
    finally:
        older.terminate()
        older.wait(20)
    require(sessions and audit["is_intact"], "sessions or audit are lost")
    return {"said": told[:60], "the older program": commit, "sessions": sessions, "audit rows": audit["rows"]}


@contextlib.contextmanager
def _bench(image: str) -> Iterator[Bench]:
    with tempfile.TemporaryDirectory(prefix="tidegate-image-") as place, network(), mounted(image) as found:
        bench = Bench(Path(place))
        bench.image = found
        new_folder(bench.place / "backup")
        volunteer(
            SimpleNamespace(mktemp=lambda _: _new(bench.place / "made")), "occlusion", volunteer=1, seconds=36.0, seed=1
        )
        (bench.place / "made" / "occlusion").rename(bench.place / "volunteer")
        yield bench


def _new(path: Path) -> Path:
    path.mkdir()
    return path


def main() -> int:
    """Run all steps."""
    parser = argparse.ArgumentParser(prog="python -m verification.image", description=__doc__)
    parser.add_argument("--image", help="of buildah's storage: test this one, build none")
    parser.add_argument("--base", help="the base image; that of the Dockerfile unless given")
    parser.add_argument("--ca-bundle", type=Path, help="certificate authorities for the build, PEM")
    parser.add_argument("--out", type=Path, help="file for all figures, in JSON")
    asked = parser.parse_args()
    name = asked.image or "localhost/tidegate:docker-test"
    _say(f"{platform.machine()}, {os.cpu_count()} processors, load average {os.getloadavg()[0]:.1f}")
    if asked.image is None:
        began_s = time.monotonic()
        told = build(name, asked.base, asked.ca_bundle)
        _say(f"{time.monotonic() - began_s:6.1f} s  build: {told}")
    with _bench(name) as bench:
        try:
            _steps(bench)
        finally:
            if asked.out is not None:
                asked.out.write_text(json.dumps(bench.found, indent=1) + "\n", encoding="utf-8")
    return 0


def _upgrade_and_back(bench: Bench, release: Path) -> None:
    upgrade: list[Any] = []

    def up() -> dict[str, object]:
        figures, *rest = upgraded(bench, release)
        upgrade.extend(rest)
        return figures

    bench.step("upgrade from an earlier version", up)
    bench.step("rollback", lambda: rolled_back(bench, release, *upgrade))


def _steps(bench: Bench) -> None:
    bench.step("what is in it", lambda: look(bench))
    data = new_folder(bench.place / "data")
    new_folder(data / "recordings" / "volunteer")
    recordings = data / "recordings" / "volunteer"
    for file in (bench.place / "volunteer").iterdir():
        (recordings / file.name).write_bytes(file.read_bytes())
    run("chown", "-R", "10001:10001", data)
    container, keys = bench.container(data), []

    def first() -> dict[str, object]:
        figures, key = first_start(bench, container)
        keys.append(key)
        return figures

    try:
        bench.step("first start", first)
        bench.step("health", lambda: health(container))
        bench.step("a whole session from outside, over TLS", lambda: whole_session(bench, container, keys[0]))
        bench.step("hung, killed by the health check, started again", lambda: hang(bench, container, keys[0]))
        bench.step("killed with the beam on, started again", lambda: killed(bench, container, keys[0]))
        bench.step("backup, restore elsewhere", lambda: backed_up(bench, container, keys[0]))
        release = newest_release()
        if release is not None:
            _upgrade_and_back(bench, release)
    finally:
        if container.process is not None:
            container.kill()


if __name__ == "__main__":
    sys.exit(main())
