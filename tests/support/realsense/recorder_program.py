"""A process that lets librealsense record the virtual camera, as its viewer does.

Run: ``python -m tests.support.realsense.recorder_program OUT SECONDS``, with the environment of the virtual camera.
"""

import os
import sys
import time
from pathlib import Path

sys.path[:0] = os.environ["CAMERA_SDK_PATH"].split(os.pathsep)

import pyrealsense2 as rs  # noqa: E402 - from the folder that was just put first


def main(out: Path, seconds: float) -> None:
    (device,) = rs.context().query_devices()
    recorder = rs.recorder(str(out), device._virtual.device)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(lambda _frame: None)
    time.sleep(seconds)
    recorder.pause()
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    del recorder


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
    os._exit(0)
