"""Cameras of an SDK that runs in a process of its own, as a :class:`engine.capture.source.CameraDriver`."""

from dataclasses import dataclass
from pathlib import Path

from engine.capture.camera_process.recorded import RecordedSource
from engine.capture.camera_process.source import ProcessSource, factory_calibration, is_sdk_installed, listed
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessDriver:
    """The driver of all addresses that begin with ``prefix``; behind it is a camera's serial number.

    Attributes
    ----------
    label, install_hint
        See :class:`engine.capture.source.CameraDriver`.
    warm_up_s
        How long readings of its cameras drift after their start [s].
    most_noise_mm
        Noise of a training from which a camera of this kind is not as it should be.
    package
        The SDK's package, which `module` alone imports, in the camera's process.
    """

    prefix: str
    label: str
    install_hint: str
    package: str
    module: str
    warm_up_s: float
    most_noise_mm: float
    is_player: bool = False

    def is_installed(self) -> bool:
        """Whether the SDK is on this machine; does not try to start it."""
        return is_sdk_installed(self.package)

    def is_available(self) -> bool:
        """Whether the SDK is on this machine: it starts in a process of its own only."""
        return self.is_installed()

    def list_cameras(self) -> list[ListedCamera]:
        """List the connected cameras; raise RuntimeMissingError where the SDK does not start."""
        return listed(self.module, self.label)

    def camera(
        self,
        uri: str | None,
        *,
        clock: Clock,
        use_registration: bool = False,
        record_to: Path | None = None,
        options: CameraOptions = AS_IT_IS,
    ) -> LiveSource:
        """Return a camera, not opened; the first one where no address is given."""
        if use_registration:
            raise SourceLostError(f"{self.label} does not register depth to colour itself")
        source = ProcessSource(self.module, self._serial(uri), clock=clock, options=options)
        return source if record_to is None else RecordedSource(source, record_to)

    def player(self, path: Path, *, clock: Clock, record_to: Path | None = None) -> LiveSource | None:  # noqa: ARG002
        """Return None: the SDK plays no ``.oni`` file."""
        return None

    def registered_view(self, uri: str) -> RegisteredView | None:  # noqa: ARG002
        """Return None: depth is moved into the colour view by the calibration."""
        return None

    def factory_calibration(self, uri: str) -> FactoryCalibration | None:
        """Return the calibration that the camera has from its maker; raise SourceLostError without the camera."""
        return factory_calibration(self.module, self._serial(uri), self.label)

    def _serial(self, uri: str | None) -> str:
        if uri is not None:
            return uri.removeprefix(self.prefix)
        found = self.list_cameras()
        if not found:
            raise SourceLostError(f"{self.label} sees no camera")
        return found[0].uri.removeprefix(self.prefix)
