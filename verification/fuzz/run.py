"""A run: targets driven, listened to, and reported in numbers; what was found is kept with how to see it again."""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.support.repository import ROOT
from verification.fuzz.options import findings_of
from verification.fuzz.target import Target

START_S = 120
_PROGRESS = re.compile(r"cov: (\d+) ft: (\d+) corp: (\d+)/")
_EXECUTIONS = re.compile(r"^(?:stat::number_of_executed_units: |#)(\d+)", re.MULTILINE)
_PEAK_MB = re.compile(r"stat::peak_rss_mb: +(\d+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a run of one target did; ``coverage`` is libFuzzer's count of edges of our own code that inputs reached."""

    target: str
    executions: int
    coverage: int
    peak_mb: int
    finding: Path | None
    said: str

    @property
    def how_to_see_it_again(self) -> str:
        """The command, and the last of what was said."""
        tail = "\n".join(self.said.splitlines()[-40:])
        command = f".venv/bin/python -m verification.fuzz --target {self.target} --replay {self.finding}"
        return f"{self.target}: what came out is no documented refusal. See it again with\n  {command}\n{tail}"


def run(targets: Sequence[Target], *, seconds: int, work: Path, inputs: int = 0, seed: int = 0) -> list[Run]:
    """Fuzz each target for so long, from the kept corpus and the one that grows in ``work``.

    With ``inputs`` given, a target ends after so many where that is sooner.
    """
    work.mkdir(parents=True, exist_ok=True)
    before = {target.name: _findings(target, work) for target in targets}
    names = [target.name for target in targets]
    ended = subprocess.run(
        [
            sys.executable,
            "-m",
            "verification.fuzz.drive",
            str(work.absolute()),
            str(seconds),
            str(inputs),
            str(seed),
            *names,
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
        timeout=2 * seconds * len(targets) + START_S,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    runs = [
        _reported(target, work, before[target.name]) for target in targets if (work / f"{target.name}.log").is_file()
    ]
    if len(runs) < len(targets) or (ended.returncode != 0 and not any(one.finding for one in runs)):
        said = ended.stdout.decode(errors="replace") + "".join(one.said[-2000:] for one in runs if not one.executions)
        msg = f"{', '.join(names)} could not be run:\n{said[-6000:]}"
        raise RuntimeError(msg)
    return runs


def _findings(target: Target, work: Path) -> set[Path]:
    folder = findings_of(target, work)
    return set(folder.iterdir()) if folder.is_dir() else set()


def _reported(target: Target, work: Path, before: set[Path]) -> Run:
    said = (work / f"{target.name}.log").read_text(encoding="utf-8", errors="replace")
    new = sorted(_findings(target, work) - before)
    return Run(
        target=target.name,
        executions=max(map(int, _EXECUTIONS.findall(said)), default=0),
        coverage=max((int(edges) for edges, _, _ in _PROGRESS.findall(said)), default=0),
        peak_mb=max(map(int, _PEAK_MB.findall(said)), default=0),
        finding=new[0] if new else None,
        said=said,
    )
