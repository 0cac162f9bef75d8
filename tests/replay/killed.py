"""A service of its own process, to be killed: `python -m tests.replay.killed DATA VOLUNTEER`."""

import sys
from pathlib import Path

from tests.replay.played import play

if __name__ == "__main__":
    play(Path(sys.argv[1]), Path(sys.argv[2]), seed=3)
