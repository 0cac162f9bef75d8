"""``python -m service.engine_process SPEECH WHISPER PAGE``: an engine's process, started by the service alone."""

import logging
import os
import signal
import sys

from service.engine_process.parting import end_with_the_service


def main() -> None:
    """Run one session for the process that started this one, and end with it."""
    # The service says when to stop: a signal to the whole group, as of Ctrl-C or of systemd, must not end the engine
    # before its session is closed.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    end_with_the_service()
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
