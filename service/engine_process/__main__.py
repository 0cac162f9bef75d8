"""``python -m service.engine_process SPEECH WHISPER PAGE``: an engine's process, started by the service alone."""

import ctypes
import logging
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
# <sys/prctl.h>


def main() -> None:
    """Run one session for the process that started this one, and end with it."""
    # The service says when to stop: a signal to the whole group, as of Ctrl-C or of systemd, must not end the engine
    # before its session is closed.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Hearing that the service is gone takes a process that runs: one that was stopped goes on when its parent ends. The
    # kernel wakes what is left of a group without a parent, too; that depends on how the groups lie.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)
    from service.engine_process.crossing import CrossingClosedError
    from service.engine_process.serving import ends_of, serve_one_session

    status = 1
    try:
        serve_one_session(*ends_of([int(one) for one in sys.argv[1:4]]))
        status = 0
    except CrossingClosedError:
        status = 0  # it was standing by, and is not needed any more
    finally:
        logging.shutdown()
        # Not by way of the interpreter's end: a camera's runtime has threads that never end.
        os._exit(status)


if __name__ == "__main__":
    main()
