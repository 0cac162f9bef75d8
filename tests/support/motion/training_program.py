"""``python -m tests.support.motion.training_program MARKER``: an engine with a training process.

It prints the id of that process, what a job sees of its own process, and then waits for a job that never ends.
"""

import json
import os
import sys
from pathlib import Path

from engine.motion.training_process.process_trainer import ProcessTrainer
from tests.support.motion.training_jobs import Described, Held
from tests.support.waiting import PATIENCE_S


def main() -> None:
    """Run jobs until this process is killed."""
    inherited = os.pipe()
    trainer = ProcessTrainer()
    trainer.start(Described())
    assert trainer.wait(PATIENCE_S)
    seen = {"server": trainer.process.process_id, "inherited": inherited, "job": trainer.collect()}
    sys.stdout.write(json.dumps(seen) + "\n")
    sys.stdout.flush()
    trainer.start(Held(Path(sys.argv[1])))
    trainer.wait(10 * PATIENCE_S)


if __name__ == "__main__":
    main()
