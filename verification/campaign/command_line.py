"""What the campaigns' commands share: bounded numbers, and the state of the code that a campaign is of."""

import argparse
import hashlib
import subprocess
from collections.abc import Callable

from tests.support.repository import ROOT

WRONG_USAGE = 2
MOST_JOBS = 16
RUN_FOLDERS = ("engine", "service", "lab", "migrations", "verification", "tests/support")


def bounded(low: int, high: int) -> Callable[[str], int]:
    """Read a number within its bounds."""

    def number(text: str) -> int:
        value = int(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{value} must be from {low} to {high}")
        return value

    return number


def revision_of_the_code() -> str:
    """Name the state of the code: the commit, and whether anything that is run differs from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("diff", "HEAD", "--", *RUN_FOLDERS)
        digest = hashlib.sha256(changed.encode()).hexdigest()[:8]
        return git("rev-parse", "--short=12", "HEAD") + (f"+{digest}" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
