"""``python -m service.engine_host.process BULK CONTROL PAGE``: an engine process; only the service starts it."""

import gc
import logging
import os
import signal
import sys

from service.engine_host.process.channels import end_with_the_service


def main() -> None:
    """Run one session for the process that started this one, and end with it."""
    # The service decides when to stop: a signal to the whole group, from Ctrl-C or systemd, must not end the engine
    # before its session is closed.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    end_with_the_service()
    from service.core.late_modules import load_when_used

    gc.disable()  # until everything is loaded
    load_when_used("cv2")  # the pipeline of a session loads it, before the first frame
    from service.engine_host.process.channels import ChannelClosedError
    from service.engine_host.process.engine_server import open_channels, serve_one_session

    status = 1
    try:
        serve_one_session(*open_channels([int(one) for one in sys.argv[1:4]]))
        status = 0
    except ChannelClosedError:
        status = 0  # it was on standby and is not needed any more
    finally:
        logging.shutdown()
        # Without the interpreter's shutdown: a camera runtime has threads that never end.
        os._exit(status)


if __name__ == "__main__":
    main()
