"""An engine's process that sees two cameras: ``python -m tests.support.engine_process.two_cameras_program``.

Its frames and its line are those of ``paced``. Asked about a camera called ``DYING`` it dies, about ``HUNG`` it hangs;
with ``ENGINE_TEST_LIST_FAILS`` it cannot list any.
"""

import os
import threading

from engine.capture import drivers
from engine.capture.source import ListedCamera, RegisteredView
from service.engine_host.process.__main__ import main
from tests.support.capture.fake_driver import FakeDriver
from tests.support.engine_process import real_time_program

REGISTERED, PLAIN, DYING, HUNG = "virtual/registered", "virtual/plain", "virtual/dying", "virtual/hung"
ALL = (REGISTERED, PLAIN, DYING, HUNG)
DEATH = 3
LIST_FAILS = "ENGINE_TEST_LIST_FAILS"


class TwoCameras(FakeDriver):
    """Fails, dies or hangs as its cameras' names say."""

    def list_cameras(self):
        if LIST_FAILS in os.environ:
            raise OSError
        return [ListedCamera(uri=uri, vendor="Virtual", name=str(os.getpid())) for uri in ALL]

    def registered_view(self, uri):
        if uri == DYING:
            os._exit(DEATH)
        if uri == HUNG:
            threading.Event().wait()
        view = RegisteredView(name="Virtual", size_px=(640, 480), field_of_view_rad=(1.0, 0.75))
        return view if uri == REGISTERED else None


if __name__ == "__main__":
    real_time_program.spoil()
    drivers.CAMERAS = (TwoCameras(),)
    main()
