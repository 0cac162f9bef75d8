"""Cameras and recordings through the OpenNI2 runtime, as a :class:`engine.capture.source.CameraDriver`."""

from pathlib import Path

from engine.capture.openni import c_api
from engine.capture.openni.device import OpenNiDevice
from engine.capture.openni.source import OpenNiSource, list_devices, runtime_available
from engine.capture.source import (
    AS_IT_IS,
    CameraOptions,
    FactoryCalibration,
    ListedCamera,
    LiveSource,
    RegisteredView,
)
from engine.core.clock import Clock
from engine.core.errors import SourceLostError

REGISTERED_SIZE_PX = (640, 480)


class OpenNiDriver:
    """The driver of all addresses that name no other SDK."""

    prefix = ""
    label = "the OpenNI2 runtime"
    is_player = True
    # AAPM TG-147 for cameras of structured light.
    warm_up_s = 900.0
    # Virtual sensors within what two real ones differ by have 5 to 7.
    most_noise_mm = 12.0
    install_hint = "apt-get install libopenni2-0"

    def is_installed(self) -> bool:
        """Whether the runtime is on this machine; does not try to start it."""
        return c_api.library_path() is not None

    def is_available(self) -> bool:
        """Whether the runtime is on this machine and starts."""
        return runtime_available()

    def list_cameras(self) -> list[ListedCamera]:
        """List the connected devices; raise RuntimeMissingError without the runtime."""
        return list_devices()

    def camera(
        self,
        uri: str | None,
        *,
        clock: Clock,
        use_registration: bool = False,
        record_to: Path | None = None,
        options: CameraOptions = AS_IT_IS,
    ) -> LiveSource:
        """Return a device, not opened; the first one where no address is given."""
        if options:
            raise SourceLostError(f"a camera of {self.label} has no preset, exposure or laser power that can be set")
        return OpenNiSource(uri, clock=clock, use_device_registration=use_registration, record_to=record_to)

    def player(self, path: Path, *, clock: Clock, record_to: Path | None = None) -> LiveSource:
        """Return what plays an ``.oni`` file in real time through the runtime."""
        return OpenNiSource(path, clock=clock, record_to=record_to)

    def factory_calibration(self, uri: str) -> FactoryCalibration | None:  # noqa: ARG002
        """Return None: the runtime reports none."""
        return None

    def registered_view(self, uri: str) -> RegisteredView | None:
        """Return the view of a device that registers depth to colour itself; None if it cannot."""
        c_api.runtime()
        device = OpenNiDevice(uri, is_file=False)
        try:
            if not device.can_register():
                return None
            return RegisteredView(
                name=device.name, size_px=REGISTERED_SIZE_PX, field_of_view_rad=device.color_view_rad()
            )
        finally:
            device.close()
