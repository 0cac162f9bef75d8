"""Orbbec cameras for the engine; imports no SDK."""

from engine.capture.camera_process.driver import ProcessDriver

ORBBEC = ProcessDriver(
    prefix="orbbec:",
    label="the Orbbec SDK",
    # The package names dependencies that it does not import, one of which fails to build: not an extra of ours.
    install_hint="pip install --no-deps pyorbbecsdk2",
    package="pyorbbecsdk",
    module="engine.capture.orbbec.camera",
)
