"""What a camera or a beam line of your own is made of; `tidegate.testing` has the rules that it must pass.

A distribution names its plug-in as an entry point: in the group ``tidegate.cameras`` an object with the members of
`CameraDriver`, such as a `CameraPlugIn`; in ``tidegate.beam_lines`` a function that makes a `Wire` of an address.
"""

from pathlib import Path

from engine.beam import Wire
from engine.capture.source import (
    AS_IT_IS,
    CameraDriver,
    CameraOptions,
    FactoryCalibration,
    ListedCamera,
    LiveSource,
    RegisteredView,
    SourceDescription,
)
from engine.core.clock import Clock
from engine.core.errors import BeamLineError, FrameTimeoutError, SourceEndedError, SourceLostError
from engine.core.frames import RgbdFrame

__all__ = [
    "BeamLineError",
    "CameraDriver",
    "CameraOptions",
    "CameraPlugIn",
    "Clock",
    "FrameTimeoutError",
    "ListedCamera",
    "LiveSource",
    "RgbdFrame",
    "SourceDescription",
    "SourceEndedError",
    "SourceLostError",
    "Wire",
]


class CameraPlugIn:
    """A `CameraDriver` of cameras that neither play recordings nor bring a calibration; override what differs.

    Attributes
    ----------
    prefix
        How the addresses of its cameras begin: letters and a colon.
    label, install_hint
        The SDK's name in messages, and what an administrator does where it is missing.
    warm_up_s
        How long readings drift after the start [s].
    most_noise_mm
        Noise of a training from which a camera is not as it should be [mm].
    """

    prefix: str
    label: str
    install_hint: str = ""
    warm_up_s: float = 1_800.0
    most_noise_mm: float = 12.0
    is_player: bool = False

    def open(self, uri: str, clock: Clock, options: CameraOptions) -> LiveSource:
        """Return the camera at an address of `list_cameras`, not opened."""
        raise NotImplementedError

    def list_cameras(self) -> list[ListedCamera]:
        """List the connected cameras."""
        raise NotImplementedError

    def is_installed(self) -> bool:
        """Whether the SDK is on this machine; does not start it."""
        return True

    def is_available(self) -> bool:
        """Whether the SDK is on this machine and starts."""
        return self.is_installed()

    def camera(
        self,
        uri: str | None,
        *,
        clock: Clock,
        use_registration: bool = False,  # noqa: ARG002 - these cameras have none
        record_to: Path | None = None,
        options: CameraOptions = AS_IT_IS,
    ) -> LiveSource:
        """Return a camera, not opened; the first one where no address is given."""
        if record_to is not None:
            msg = f"{self.label} writes no recordings itself"
            raise SourceLostError(msg)
        found = [one.uri for one in self.list_cameras()]
        if not found or (uri is not None and uri not in found):
            msg = f"{self.label} sees no such camera"
            raise SourceLostError(msg)
        return self.open(uri or found[0], clock, options)

    def player(self, path: Path, *, clock: Clock, record_to: Path | None = None) -> LiveSource | None:  # noqa: ARG002
        """Play no recording."""
        return None

    def registered_view(self, uri: str) -> RegisteredView | None:  # noqa: ARG002
        """Register nothing."""
        return None

    def factory_calibration(self, uri: str) -> FactoryCalibration | None:  # noqa: ARG002
        """Bring no calibration."""
        return None
