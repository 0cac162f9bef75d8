"""A run of one target: started, listened to, and told in numbers; what it found is kept with how to see it again."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.target import ROOT, Target

TIMEOUT_S = 10
MEMORY_MB = 1024
_PROGRESS = re.compile(r"cov: (\d+) ft: (\d+) corp: (\d+)/")
_EXECUTIONS = re.compile(r"^(?:stat::number_of_executed_units: |Done )(\d+)", re.MULTILINE)
_COUNTED = re.compile(r"^#(\d+)", re.MULTILINE)
_PEAK_MB = re.compile(r"stat::peak_rss_mb: +(\d+)")
_SECONDS = re.compile(r"Done \d+ runs in (\d+) second")


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a run did; ``coverage`` is libFuzzer's count of edges of our own code that inputs reached."""

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
        command = f".venv/bin/python -m tests.fuzz --target {self.target} --replay {self.finding}"
        return (
            f"{self.target}: something came out that is no documented refusal. See it again with\n  {command}\n{tail}"
        )


def run(target: Target, *, seconds: int, work: Path, seed: int | None = None) -> Run:
    """Fuzz one target for a while, from the corpus that is kept and the one that grows in ``work``."""
    grown, found = work / "grown" / target.name, work / "findings"
    grown.mkdir(parents=True, exist_ok=True)
    found.mkdir(parents=True, exist_ok=True)
    dictionary = _dictionary(target, work)
    before = set(found.iterdir())
    options = [
        f"-max_total_time={seconds}",
        f"-max_len={target.max_bytes}",
        f"-timeout={TIMEOUT_S}",
        f"-rss_limit_mb={MEMORY_MB}",
        f"-artifact_prefix={found}/{target.name}-",
        *([] if dictionary is None else [f"-dict={dictionary}"]),
        "-print_final_stats=1",
        *([] if seed is None else [f"-seed={seed}"]),
    ]
    folders = [str(grown), *([str(target.corpus)] if target.corpus.is_dir() else [])]
    ended = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.drive", target.name, *options, *folders],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
        timeout=seconds + 120,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    said = ended.stdout.decode(errors="replace")
    new = sorted(set(found.iterdir()) - before)
    if ended.returncode != 0 and not new:
        msg = f"{target.name} could not be run:\n{said[-4000:]}"
        raise RuntimeError(msg)
    return Run(
        target=target.name,
        executions=max((int(count) for count in [*_COUNTED.findall(said), *_EXECUTIONS.findall(said)]), default=0),
        coverage=max((int(cov) for cov, _, _ in _PROGRESS.findall(said)), default=0),
        peak_mb=max(map(int, _PEAK_MB.findall(said)), default=0),
        finding=new[0] if new else None,
        said=said,
    )


def _dictionary(target: Target, work: Path) -> Path | None:
    """Write the words down as libFuzzer wants them; it refuses a file without any."""
    if not target.words:
        return None
    path = work / f"{target.name}.dict"
    words = (word.replace('"', '\\"') for word in target.words)
    path.write_text("".join(f'"{word}"\n' for word in words), encoding="utf-8")
    return path
