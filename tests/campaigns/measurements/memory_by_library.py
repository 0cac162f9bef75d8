"""Memory of a service by process and library: ``python -m tests.campaigns.measurements.memory_by_library [--pid PID]``.

Without a process id it starts a real service, and prints its memory idle and with an armed session. A page that n
processes share counts as 1/n of a page for each of them (the kernel's PSS), so that the rows of a table add up. Memory
of no file is the heap's and Python's objects'.
"""

import argparse
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from engine.verification.performance.recording import make_recording
from tests.campaigns.load.service import learn, served, start_session
from tests.campaigns.load.usage import family

RECORDING_S = 120.0
SETTLED_S = 5.0
LEAST_MB = 0.5
ROLES = (
    ("engine.motion.training_process", "training"),
    ("service.engine_host.process", "engine"),
    ("service.cli", "web"),
)
OWN_MEMORY = "heap and Python's objects"
_RANGE = re.compile(r"^[0-9a-f]+-[0-9a-f]+ ")
_PACKAGE = re.compile(r"/site-packages/([^/]+)")


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pid", type=int, help="process id of a running service")
    asked = parser.parse_args(arguments)
    if asked.pid is not None:
        sys.stdout.write(table(asked.pid))
        return 0
    with tempfile.TemporaryDirectory(prefix="tidegate-memory-") as folder:
        _measure(Path(folder))
    return 0


def _measure(place: Path) -> None:
    made = make_recording(place / "made", RECORDING_S, lambda _done, _all: None)
    recording = made / "recording.oni"
    with served(place, made) as service:
        time.sleep(SETTLED_S)
        sys.stdout.write(f"idle\n{table(service.process.pid)}\n")
        given = learn(service, made, recording)
        start_session(service, recording, given)
        time.sleep(SETTLED_S)
        sys.stdout.write(f"armed, with a model of an earlier session\n{table(service.process.pid)}\n")


def table(process_id: int) -> str:
    """Return the memory of a process and all below it, by library, as text."""
    found = {f"{_role(one)} {one}": by_library(smaps(one)) for one in family(process_id)}
    found = {name: parts for name, parts in found.items() if parts}
    total = Counter[str]()
    for parts in found.values():
        total.update(parts)
    lines = ["".join(f"{text:>20}" for text in ("MB", *found))]
    for library, mb in [*total.most_common(), ("all", sum(total.values()))]:
        if mb >= LEAST_MB:
            values = [sum(parts.values()) if library == "all" else parts[library] for parts in found.values()]
            lines.append("".join(f"{value:>20.1f}" for value in (mb, *values)) + f"  {library}")
    return "\n".join(lines) + "\n"


def smaps(process_id: int) -> str:
    """Read the mappings of a process; empty where it has ended or is another user's."""
    try:
        return Path(f"/proc/{process_id}/smaps").read_text(encoding="utf-8")
    except OSError:
        return ""


def by_library(text: str) -> Counter[str]:
    """Sum up the memory of mappings by library [MB]."""
    found = Counter[str]()
    for name, figures in _mappings(text):
        found[library_of(name)] += figures.get("Pss", 0) * 1024 / 1e6
    return found


def _mappings(text: str) -> Iterator[tuple[str, Mapping[str, int]]]:
    name, figures = "", dict[str, int]()
    for line in text.splitlines():
        if _RANGE.match(line):
            if figures:
                yield name, figures
            parts = line.split(maxsplit=5)
            name, figures = parts[5] if len(parts) > 5 else "", {}
        elif line.endswith(" kB"):
            key, value, _ = line.split()
            figures[key.rstrip(":")] = int(value)
    if figures:
        yield name, figures


def library_of(name: str) -> str:
    """Return the library that a mapping belongs to, by its file's name."""
    if not name.startswith("/"):
        return "stacks" if name == "[stack]" else OWN_MEMORY
    if name.startswith(("/memfd:", "/dev/")):
        return "shared memory"
    package = _PACKAGE.search(name)
    if package is not None:
        return package[1].removesuffix(".libs").partition(".")[0]
    return "Python" if "python" in Path(name).name else re.split(r"[-.]\d|\.so", Path(name).name)[0]


def _role(process_id: int) -> str:
    words = Path(f"/proc/{process_id}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return next((role for mark, role in ROLES if mark in words), "other")


if __name__ == "__main__":
    sys.exit(main())
