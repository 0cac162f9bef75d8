"""RealSense cameras for the engine; imports no SDK."""

from engine.capture.camera_process.driver import ProcessDriver

REALSENSE = ProcessDriver(
    prefix="realsense:",
    label="the RealSense SDK",
    install_hint="pip install 'tidegate[realsense]'",
    package="pyrealsense2",
    module="engine.capture.realsense.camera",
    # Users report drifts of 4 to 12 mm over 30 minutes.
    warm_up_s=1800.0,
    # A virtual one from published figures has 17.
    most_noise_mm=30.0,
)
