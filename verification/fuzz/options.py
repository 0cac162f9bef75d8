"""What libFuzzer is reported about a target, and where its inputs grow."""

from pathlib import Path

from verification.fuzz.target import Target

TIMEOUT_S = 10
MEMORY_MB = 1024


def options_of(target: Target, *, work: Path, seconds: int, inputs: int = 0, seed: int) -> list[str]:
    """Options and folders: the corpus grows in ``work``, where the kept one is unpacked; findings come beside it."""
    grown, kept = work / "grown" / target.name, work / "kept" / target.name
    for folder in (grown, kept):
        folder.mkdir(parents=True, exist_ok=True)
    for name, content in target.kept().items():
        (kept / name).write_bytes(content)
    findings_of(target, work).mkdir(parents=True, exist_ok=True)
    words = dictionary(target, work)
    return [
        f"-max_total_time={seconds}",
        f"-max_len={target.max_bytes}",
        f"-timeout={TIMEOUT_S}",
        f"-rss_limit_mb={MEMORY_MB}",
        f"-artifact_prefix={findings_of(target, work)}/",
        "-print_final_stats=1",
        *([f"-runs={inputs}"] if inputs else []),
        *([f"-seed={seed}"] if seed else []),
        *([f"-dict={words}"] if words else []),
        str(grown),
        str(kept),
    ]


def findings_of(target: Target, work: Path) -> Path:
    """Where inputs lie that something came of."""
    return work / "findings" / target.name


def dictionary(target: Target, work: Path) -> Path | None:
    """Write the words down as libFuzzer wants them; it refuses a file without any."""
    if not target.words:
        return None
    path = work / f"{target.name}.dict"
    words = (word.replace('"', '\\"') for word in target.words)
    path.write_text("".join(f'"{word}"\n' for word in words), encoding="utf-8")
    return path
