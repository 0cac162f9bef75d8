"""The engine's process with a saboteur inside; it listens beside the service's, under this process's own number."""

import os

from service.engine_host.process.__main__ import main
from verification.faults.fault_injector import let_in

MARK = "verification.faults.engine_program"
PATH_NAME = "FAULTS_SABOTEUR"


def path_of(path: str, pid: int) -> str:
    """Where the saboteur of an engine's process listens."""
    return f"{path}-{pid}"


if __name__ == "__main__":
    let_in(path_of(os.environ[PATH_NAME], os.getpid()))
    main()
