"""A real service on paced engines in processes of their own: ``python -m tests.engine_process.service DATA PORT``."""

import contextlib
import sys
from pathlib import Path

from service.app import create_app
from service.engine_process import child
from service.engine_process.port import ProcessEngine
from service.server import make_server
from service.settings import Settings
from tests.engine_process.bench import PACED, PATIENT


def main() -> None:
    data, port = sys.argv[1:]
    child.MODULE = PACED
    recordings = Path(data).parent
    settings = Settings(data_dir=Path(data), recordings_dirs=(recordings,), port=int(port), **PATIENT)
    with contextlib.suppress(KeyboardInterrupt):
        app = create_app(settings, ProcessEngine)
        make_server(app, host=settings.host, port=settings.port, doors=settings.doors).run()


if __name__ == "__main__":
    main()
