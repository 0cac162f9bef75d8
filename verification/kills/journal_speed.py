"""What keeping a transition costs beside a busy disk.

Run: ``python -m verification.kills.journal_speed --seconds 60 FOLDER...``.

One process a folder writes a transition every 5 ms into a real journal there, while others fill and sync the disk of
the current folder. What counts is whether a write ever *slept*, that is waited for something: being preempted on a busy
machine takes as long and is no one's doing.
"""

import argparse
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from engine.control.journal.journal import TransitionJournal
from engine.control.outputs import GateTransition
from engine.core.clock import MonotonicClock
from engine.core.gate_state import GateState, HoldReason

STEP_S = 0.005
LOAD = (
    "while true; do dd if=/dev/zero of={folder}/large bs=1M count=1500 status=none; sync {folder}/large; done",
    "while true; do dd if=/dev/zero of={folder}/small bs=4k count=2000 oflag=dsync status=none; done",
    "while true; do sync; sleep 0.5; done",
)


def measure(folder: Path, seconds: float) -> str:
    """Write for so long; return one line that says what it took."""
    folder.mkdir(parents=True, exist_ok=True)
    journal = TransitionJournal(folder / f"speed-{os.getpid()}", session_id="speed", clock=MonotonicClock())
    took_ns, slept_ns = [], []
    try:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            reported = _transition(time.monotonic_ns())
            waits, began_ns = _waits(), time.monotonic_ns()
            number = journal.commit(reported)
            took_ns.append(time.monotonic_ns() - began_ns)
            slept_ns += [took_ns[-1]] if _waits() > waits else []
            journal.acknowledge(number or 0)
            time.sleep(STEP_S)
    finally:
        journal.close()
    took_ns.sort()
    shares = ", ".join(f"p{share:g} {took_ns[int(len(took_ns) * share / 100)] / 1e3:.0f}" for share in (50, 99, 99.9))
    slept = f"{len(slept_ns)} slept" + (f", {max(slept_ns) / 1e6:.1f} ms at worst" if slept_ns else "")
    return f"{folder}: {len(took_ns)} writes, {shares}, max {took_ns[-1] / 1e3:.0f} us; {slept}"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m verification.kills.journal_speed", description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--seconds", type=float, default=60.0)
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        load = [
            subprocess.Popen(["/bin/sh", "-c", words.format(folder=folder)], start_new_session=True) for words in LOAD
        ]
        try:
            with multiprocessing.Pool(len(asked.folders)) as pool:
                for line in pool.starmap(measure, [(path, asked.seconds) for path in asked.folders]):
                    sys.stdout.write(line + "\n")
        finally:
            for process in load:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    return 0


def _waits() -> int:
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


def _transition(at_ns: int) -> GateTransition:
    return GateTransition(
        at_ns=at_ns,
        frame_index=1,
        from_state=GateState.BEAM_ON,
        to_state=GateState.HOLD,
        reason=HoldReason.OUTSIDE_WINDOW,
        operator=None,
        detail="4.3 mm is above 4 mm",
        captured_us=1,
        received_ns=at_ns,
        decided_ns=at_ns,
        asserted_ns=at_ns,
    )


if __name__ == "__main__":
    sys.exit(main())
