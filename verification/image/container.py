"""An image's file system and containers on it: namespaces of its own, root read-only, one user, a network of two ends.

Debian's buildah has no option for a read-only root and adds an init of its own; `unshare` and `mount` do what an engine
does with the options of docker/room/compose.yaml. What an engine adds beside (seccomp, cgroups) is not tested here.
"""

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

UID = 10001
HOST_ADDRESS, ADDRESS = "10.213.77.1", "10.213.77.2"
NETWORK = "tidegate-test"
PYTHON = "/opt/tidegate/bin/python"
ENTER = "import os, subprocess, sys; os.environ['PATH'] = '/opt/tidegate/bin:/usr/bin'; os.chdir('/data'); "
EXEC = f"{ENTER}os.execvp(sys.argv[1], sys.argv[1:])"
"""What an engine does last: the image's own PATH and folder, then the command."""
FORK = f"{ENTER}sys.exit(subprocess.call(sys.argv[1:]))"
"""The same behind a first process that only waits, as with an engine's init."""
STOP_S = 20.0

INIT = """set -e
PATH=/usr/sbin:/usr/bin:/sbin:/bin
mount --bind {root} {root}
{binds}
mount -t tmpfs -o size=64m,noexec,nosuid,nodev tmpfs {root}/tmp
mount -t proc proc {root}/proc
mount -t tmpfs -o mode=755 tmpfs {root}/dev
for one in 'null 1 3' 'zero 1 5' 'full 1 7' 'random 1 8' 'urandom 1 9'; do
  set -- $one; mknod -m 666 {root}/dev/$1 c $2 $3
done
mkdir {root}/dev/shm && mount -t tmpfs -o mode=1777 tmpfs {root}/dev/shm
mount -o remount,bind,ro {root}
exec setpriv --no-new-privs chroot --userspec={uid}:{uid} --groups={uid} {root} {command}
"""


def run(*words: object, **options: Any) -> str:
    """Run a command and return what it printed; raise with its error where it fails."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False, **options)
    if done.returncode:
        raise RuntimeError(
            f"{' '.join(map(str, words))}: {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-4000:]}"
        )
    return done.stdout


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """An image that is mounted, and what its configuration says."""

    name: str
    root: Path
    config: dict[str, Any]
    size_mb: int

    @property
    def environment(self) -> dict[str, str]:
        return dict(one.split("=", 1) for one in self.config["Env"])


@contextlib.contextmanager
def mounted(name: str) -> Iterator[Image]:
    """Mount an image's file system until the block ends."""
    container = run("buildah", "from", "--pull-never", name).strip()
    try:
        root = Path(run("buildah", "mount", container).strip())
        told = json.loads(run("buildah", "inspect", "--type", "image", name))
        size = next(one["size"] for one in json.loads(run("buildah", "images", "--json", name)))
        yield Image(name=name, root=root, config=told["Docker"]["config"], size_mb=_mb(size))
    finally:
        run("buildah", "rm", container)


def _mb(size: str) -> int:
    number, unit = size.split()
    return round(float(number) * {"KB": 1e-3, "MB": 1.0, "GB": 1e3}[unit])


@contextlib.contextmanager
def network() -> Iterator[None]:
    """A network namespace for the containers, with one wire to this machine: clients come from outside."""
    run("ip", "netns", "add", NETWORK)
    try:
        run("ip", "link", "add", "tgt0", "type", "veth", "peer", "name", "tgt1", "netns", NETWORK)
        run("ip", "addr", "add", f"{HOST_ADDRESS}/30", "dev", "tgt0")
        run("ip", "link", "set", "tgt0", "up")
        for words in (f"addr add {ADDRESS}/30 dev tgt1", "link set tgt1 up", "link set lo up"):
            run("ip", "-n", NETWORK, *words.split())
        yield
    finally:
        run("ip", "netns", "delete", NETWORK)


@dataclass(slots=True, kw_only=True)
class Container:
    """One container: its data folder, its other folders, its settings; started, stopped, killed and started again."""

    image: Image
    data: Path
    log: Path
    folders: Mapping[str, Path] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    has_init: bool = False
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0

    @property
    def environment(self) -> dict[str, str]:
        return {**self.image.environment, **self.settings}

    def start(self, *command: str) -> Self:
        """Start it with the image's command, or another of `tidegate`'s."""
        words = [*self.image.config["Entrypoint"], *(command or self.image.config["Cmd"])]
        with self.log.open("ab") as output:
            self.started_s = time.monotonic()
            self.process = subprocess.Popen(
                self._words(words), stdin=subprocess.DEVNULL, stdout=output, stderr=output, env=self.environment
            )
        return self

    def command(self, *command: str, text: str = "", is_refusal_expected: bool = False) -> str:
        """Run one command of `tidegate`'s in a container of its own, on the same folders."""
        words = [*self.image.config["Entrypoint"], *command]
        done = subprocess.run(
            self._words(words), input=text, capture_output=True, text=True, check=False, env=self.environment
        )
        if bool(done.returncode) is not is_refusal_expected:
            raise RuntimeError(f"tidegate {' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout + done.stderr

    def execute(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command in the running container, as an engine runs a health check."""
        inside = ("-S", str(UID), "-G", str(UID), "-m", "-p", "-n", "-i", "-u", f"--root={self._own_root()}")
        return subprocess.run(
            ["nsenter", "-t", str(self.pid), *inside, "--", *words],
            capture_output=True,
            text=True,
            check=False,
            env=self.environment,
        )

    def _own_root(self) -> str:
        return f"/proc/{self.pid}/root"

    @property
    def pid(self) -> int:
        """The container's first process, as this machine counts."""
        assert self.process is not None
        pid = self.process.pid
        return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])

    def processor_s(self) -> float:
        """Return what all its processes have used of the processors [s]."""
        ticks = os.sysconf("SC_CLK_TCK")
        total = 0
        for pid in self.pids():
            with contextlib.suppress(OSError):
                total += sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15]))
        return total / ticks

    def pids(self) -> list[int]:
        """Return all its processes."""
        own = Path(f"/proc/{self.pid}/ns/pid").readlink()
        found = []
        for folder in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if folder.name.isdecimal() and (folder / "ns/pid").readlink() == own:
                    found.append(int(folder.name))
        return found

    def stop(self) -> float:
        """Stop it as an engine does; return how long that took [s]."""
        assert self.process is not None
        began_s = time.monotonic()
        os.kill(self.pid, signal.SIGTERM)
        code = self.process.wait(STOP_S)
        if code:
            raise RuntimeError(f"the container ended with {code}: {self.log.read_text()[-2000:]}")
        return time.monotonic() - began_s

    def kill(self) -> None:
        """Kill its first process, and with it all."""
        assert self.process is not None
        if self.process.poll() is None:
            os.kill(self.pid, signal.SIGKILL)
        self.process.wait()

    def _words(self, command: list[str]) -> list[str]:
        root, folders = self.image.root, {"/data": self.data, **self.folders}
        binds = []
        for place, folder in folders.items():
            inside = root / place.lstrip("/")
            inside.mkdir(exist_ok=True)  # an engine makes the place of a volume, too
            binds.append(f"mount --bind {folder} {inside}")
        entered = shlex.join([PYTHON, "-c", FORK if self.has_init else EXEC, *command])
        script = INIT.format(root=root, binds="\n".join(binds), uid=UID, command=entered)
        apart = ("--mount", "--pid", "--ipc", "--uts", "--fork", "--kill-child", "--propagation", "private")
        return [_tool("ip"), "netns", "exec", NETWORK, _tool("unshare"), *apart, _tool("bash"), "-c", script]


def _tool(name: str) -> str:
    found = shutil.which(name)
    assert found is not None, f"not on this machine: {name}"
    return found


def new_folder(path: Path, source: Path | None = None) -> Path:
    """Make a folder that belongs to the image's user, as a volume does; with the content of another."""
    if source is None:
        path.mkdir(parents=True)
    else:
        shutil.copytree(source, path)
    for one in (path, *path.rglob("*")):
        os.chown(one, UID, UID)
    path.chmod(0o700)
    return path
