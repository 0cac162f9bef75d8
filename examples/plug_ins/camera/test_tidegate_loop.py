"""Its rules: LOOP_RECORDING=recording.oni pytest."""

from tidegate_loop import DRIVER

from tidegate.testing import CameraRules


class TestLoop(CameraRules):
    driver = DRIVER
