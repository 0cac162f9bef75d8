"""RealSense cameras, as a :class:`engine.capture.source.CameraDriver`; imports no SDK."""

from pathlib import Path

from engine.capture.camera_process.source import ProcessSource, factory_calibration, is_sdk_installed, listed
from engine.capture.source import FactoryCalibration, ListedCamera, LiveSource, RegisteredView
from engine.core.clock import Clock
from engine.core.errors import SourceLostError

MODULE = "engine.capture.realsense.camera"
SDK = "pyrealsense2"


class RealSenseDriver:
    """The driver of all addresses that begin with ``realsense:``; behind it is the camera's serial number."""

    prefix = "realsense:"
    label = "the RealSense SDK"
    is_player = False
    install_hint = "pip install 'tidegate[realsense]'"

    def is_installed(self) -> bool:
        """Whether the SDK is on this machine; does not try to start it."""
        return is_sdk_installed(SDK)

    def is_available(self) -> bool:
        """Whether the SDK is on this machine: it starts in a process of its own only."""
        return self.is_installed()

    def list_cameras(self) -> list[ListedCamera]:
        """List the connected cameras; raise RuntimeMissingError where the SDK does not start."""
        return listed(MODULE, self.label)

    def camera(
        self, uri: str | None, *, clock: Clock, use_registration: bool = False, record_to: Path | None = None
    ) -> LiveSource:
        """Return a camera, not opened; the first one where no address is given."""
        if use_registration or record_to is not None:
            what = "registers depth to colour" if use_registration else "writes .oni files"
            raise SourceLostError(f"{self.label} {what} not by itself")
        return ProcessSource(MODULE, self._serial(uri), clock=clock)

    def player(self, path: Path, *, clock: Clock, record_to: Path | None = None) -> LiveSource | None:  # noqa: ARG002
        """Return None: the SDK plays no ``.oni`` file."""
        return None

    def registered_view(self, uri: str) -> RegisteredView | None:  # noqa: ARG002
        """Return None: depth is moved into the colour view by the calibration."""
        return None

    def factory_calibration(self, uri: str) -> FactoryCalibration | None:
        """Return the calibration that the camera has from its maker; raise SourceLostError without the camera."""
        return factory_calibration(MODULE, self._serial(uri), self.label)

    def _serial(self, uri: str | None) -> str:
        if uri is not None:
            return uri.removeprefix(self.prefix)
        found = self.list_cameras()
        if not found:
            raise SourceLostError(f"{self.label} sees no camera")
        return found[0].uri.removeprefix(self.prefix)
