"""``python -m engine.capture.camera_process``: see :mod:`engine.capture.camera_process.server`."""

import sys

from engine.capture.camera_process.server import main

sys.exit(main(sys.argv[1:]))
