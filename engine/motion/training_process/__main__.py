"""``python -m engine.motion.training_process CHANNEL PARENT``: a training process; only the engine starts it."""

import os
import socket
import sys

NICENESS = 10
"""Frames win from the first import on."""


def main() -> None:
    """Run jobs for the process that started this one, and end with it."""
    os.nice(NICENESS)
    import engine.motion.job_stages  # noqa: F401 - what jobs are made of, before the first one
    from engine.motion.training_process.server import serve

    serve(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]))


if __name__ == "__main__":
    main()
