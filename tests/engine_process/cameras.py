"""An engine's process that sees two cameras: ``python -m tests.engine_process.cameras``.

Its frames and its line are those of ``paced``. Asked about a camera called ``DYING`` it dies, about ``HUNG`` it hangs;
with ``ENGINE_TEST_LIST_FAILS`` it cannot list any.
"""

import os
import threading

from engine.calibration import nominal_calibration
from engine.capture.openni import ListedDevice
from service import engine_adapter
from service.engine_process.__main__ import main
from tests.engine_process import paced

REGISTERED, PLAIN, DYING, HUNG = "virtual/registered", "virtual/plain", "virtual/dying", "virtual/hung"
ALL = (REGISTERED, PLAIN, DYING, HUNG)
DEATH = 3
LIST_FAILS = "ENGINE_TEST_LIST_FAILS"


def _listed():
    if LIST_FAILS in os.environ:
        raise OSError
    return [ListedDevice(uri=uri, vendor="Virtual", name=str(os.getpid())) for uri in ALL]


def _registered(uri):
    if uri == DYING:
        os._exit(DEATH)
    if uri == HUNG:
        threading.Event().wait()
    return (
        nominal_calibration("Virtual", size_px=(640, 480), field_of_view_rad=(1.0, 0.75)) if uri == REGISTERED else None
    )


if __name__ == "__main__":
    paced.spoil()
    engine_adapter.list_devices = _listed
    engine_adapter.registered_calibration = _registered
    engine_adapter.runtime_available = lambda: True
    main()
