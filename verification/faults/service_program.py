"""The real service with a saboteur in each of its processes.

Run: ``python -m verification.faults.service_program SOCKET serve ...``.
"""

import ctypes
import os
import resource
import signal
import sys

from service.engine_host.process import messages
from verification.faults import engine_program
from verification.faults.fault_injector import let_in

MOST_FILES = 256
DIES_WITH_ITS_PARENT = 1
"""``PR_SET_PDEATHSIG``: a campaign that is killed leaves no service behind."""


def main() -> None:
    path = sys.argv.pop(1)
    ctypes.CDLL(None).prctl(DIES_WITH_ITS_PARENT, signal.SIGKILL)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(MOST_FILES, hard), hard))
    let_in(path)
    messages.MODULE = engine_program.__name__
    os.environ[engine_program.PATH_NAME] = path
    from service.cli import main as tidegate

    tidegate()


if __name__ == "__main__":
    main()
