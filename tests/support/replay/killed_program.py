"""A service of its own process, to be killed: `python -m tests.support.replay.killed_program DATA VOLUNTEER`."""

import sys
from pathlib import Path

from tests.support.replay.real_sessions import play

if __name__ == "__main__":
    play(Path(sys.argv[1]), Path(sys.argv[2]), seed=3)
