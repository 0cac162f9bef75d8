"""Orbbec cameras for the engine; imports no SDK."""

from engine.capture.camera_process.driver import ProcessDriver

ORBBEC = ProcessDriver(
    prefix="orbbec:",
    label="the Orbbec SDK",
    # The package names dependencies that it does not import, one of which fails to build: not an extra of ours.
    install_hint="pip install --no-deps pyorbbecsdk2",
    package="pyorbbecsdk",
    module="engine.capture.orbbec.camera",
    # 40 to 50 minutes were measured on the sensor that Femto cameras have (PMC7827245).
    warm_up_s=2700.0,
    # A virtual one from published figures has 2.
    most_noise_mm=8.0,
)
