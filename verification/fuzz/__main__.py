"""``python -m verification.fuzz``.

Fuzz for some minutes, read one input again, make the corpus small, print the record.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from verification.fuzz import record
from verification.fuzz.minimise import keep
from verification.fuzz.run import run
from verification.fuzz.target import Target
from verification.fuzz.targets import TARGETS

CRASHERS = "crash-"
"""Inputs that once found something keep this at the front of their name, and stay in the corpus for ever."""


def main() -> int:
    """Do what was asked."""
    asked = _asked()
    targets = [TARGETS[name] for name in asked.target or TARGETS]
    if asked.report:
        print(record.table())  # noqa: T201 - it is what the command is for
        return 0
    if asked.replay:
        return _replay(targets[0], asked.replay)
    if asked.minimise:
        _minimise(targets, asked.work)
        return 0
    return _fuzz(targets, round(60 * asked.minutes), asked.work, is_recorded=asked.record, until=asked.until)


def _asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m verification.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="in all, shared by the targets")
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="only this one; repeatable")
    parser.add_argument("--work", type=Path, default=Path("build/fuzz"), help="where inputs grow and findings lie")
    parser.add_argument("--record", action="store_true", help="add what was done to verification/fuzz/record.json")
    parser.add_argument("--until", type=Path, help="stop between two targets once this file is there")
    parser.add_argument("--replay", type=Path, help="read this input again, with --target")
    parser.add_argument("--minimise", action="store_true", help="make the corpus anew, of seeds, corpus and what grew")
    parser.add_argument("--report", action="store_true", help="print what recorded runs did")
    return parser.parse_args()


def _replay(target: Target, path: Path) -> int:
    was_read = target.try_one(path.read_bytes())
    print(f"{target.name}: {'read' if was_read else 'refused as documented'}")  # noqa: T201
    return 0


def _minimise(targets: Sequence[Target], work: Path) -> None:
    for target in targets:
        grown = work / "grown" / target.name
        kept = target.kept()
        inputs = [*target.seeds(), *kept.values(), *(path.read_bytes() for path in grown.glob("*"))]
        chosen = keep(target, inputs, {name: kept[name] for name in kept if name.startswith(CRASHERS)})
        size = sum(map(len, chosen.values()))
        print(f"{target.name}: {len(inputs)} inputs to {len(chosen)}, {size} bytes")  # noqa: T201


def _fuzz(targets: Sequence[Target], seconds: int, work: Path, *, is_recorded: bool, until: Path | None) -> int:
    findings = 0
    share_s = max(1, seconds // len(targets))
    for target in targets:
        if until is not None and until.exists():
            break
        begin_s = time.monotonic()
        (done,) = run([target], seconds=share_s, work=work)
        if is_recorded:
            record.add(done, round(time.monotonic() - begin_s))
        words = f"{done.executions:,} executions, {done.coverage} edges, {done.peak_mb} MB at most"
        print(f"{target.name}: {words}", flush=True)  # noqa: T201
        if done.finding is not None:
            findings += 1
            print(done.how_to_see_it_again, flush=True)  # noqa: T201
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
