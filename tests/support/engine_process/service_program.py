"""A real service on paced engines in processes of their own.

Run: ``python -m tests.support.engine_process.service_program DATA PORT``.
"""

import contextlib
import sys
from pathlib import Path

from service.core.settings.settings import Settings
from service.engine_host.process import child_process
from service.engine_host.process.process_engine import ProcessEngine
from service.web.app import create_app
from service.web.server import make_server
from tests.support.engine_process.bench import PACED, PATIENT


def main() -> None:
    data, port = sys.argv[1:]
    child_process.MODULE = PACED
    recordings = Path(data).parent
    settings = Settings(data_dir=Path(data), recordings_dirs=(recordings,), port=int(port), **PATIENT)
    with contextlib.suppress(KeyboardInterrupt):
        app = create_app(settings, ProcessEngine)
        make_server(app, host=settings.host, port=settings.port, connection_limits=settings.connection_limits).run()


if __name__ == "__main__":
    main()
