"""A real service on paced engines in processes of their own.

Run: ``python -m tests.support.engine_process.service_program DATA PORT``. SIGUSR1 blocks its event loop until somebody
writes to the pipe that ``SERVICE_TEST_PIPE`` names.
"""

import contextlib
import os
import signal
import sys
from pathlib import Path
from types import FrameType

from service.core.settings.settings import Settings
from service.engine_host.process import messages
from service.engine_host.process.process_engine import ProcessEngine
from service.web.app import create_app
from service.web.server import make_server
from tests.support.engine_process.bench import PACED, PATIENT

PIPE = "SERVICE_TEST_PIPE"


def _block_event_loop(_number: int, _frame: FrameType | None) -> None:
    """Block the main thread, on which the event loop runs; all other threads go on."""
    Path(os.environ[PIPE]).read_bytes()


def main() -> None:
    data, port = sys.argv[1:]
    signal.signal(signal.SIGUSR1, _block_event_loop)
    messages.MODULE = PACED
    recordings = Path(data).parent
    settings = Settings(data_dir=Path(data), recordings_dirs=(recordings,), port=int(port), **PATIENT)
    with contextlib.suppress(KeyboardInterrupt):
        app = create_app(settings, ProcessEngine)
        make_server(app, host=settings.host, port=settings.port).run()


if __name__ == "__main__":
    main()
