"""An engine's process that sees two cameras: ``python -m tests.support.engine_process.two_cameras_program``.

Its frames and its line are those of ``paced``. Asked about a camera called ``DYING`` it dies, about ``HUNG`` it hangs;
with ``ENGINE_TEST_LIST_FAILS`` it cannot list any.
"""

import os
import threading

from engine.calibration.camera_calibration import nominal_calibration
from engine.capture.openni.source import ListedDevice
from service.engine_host import local_engine
from service.engine_host.process.__main__ import main
from tests.support.engine_process import real_time_program

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
    real_time_program.spoil()
    local_engine.list_devices = _listed
    local_engine.registered_calibration = _registered
    local_engine.runtime_available = lambda: True
    main()
