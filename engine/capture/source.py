"""The roles of a frame source and of a camera driver."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Protocol, runtime_checkable

from engine.core.clock import Clock
from engine.core.frames import RgbdFrame
from engine.core.geometry import Intrinsics, RigidTransform


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceDescription:
    """Description of a source, for the audit and the page; ``serial`` is empty for a device without one.

    ``cold_share`` is how cold it is as it is opened (`engine.core.warmth`), None where that is not known: cold.
    """

    kind: str
    name: str
    depth_size: tuple[int, int]
    color_size: tuple[int, int]
    fps: float
    is_live: bool
    serial: str = ""
    cold_share: float | None = None


class DepthSource(Protocol):
    """A camera, a recording or a simulator; owned by one thread.

    A source converts device units to millimetres and stamps frames with the engine's clock; no caller ever sees raw
    counts. It delivers every frame exactly once, in order; ``missed_frames`` counts what the device lost.
    """

    def open(self) -> SourceDescription:
        """Acquire the device and start its streams; raise SourceLostError or RecordingError."""

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame.

        Raises
        ------
        FrameTimeoutError
            No frame came in time; the source is still usable. A SourceAwayError means that the camera is disconnected.
        SourceEndedError
            The recording has ended.
        SourceLostError
            The device is disconnected.
        RecordingError
            The recording is damaged from here on.
        """

    def close(self) -> None:
        """Release the device; safe to call twice, and after a failure."""


class LiveSource(DepthSource, Protocol):
    """A source whose driver may hang."""

    @property
    def is_free(self) -> bool:
        """Whether no call of it hangs in the driver any more, after :meth:`close`."""


@runtime_checkable
class TemperatureSource(Protocol):
    """A source whose camera reports its temperature."""

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the depth sensor or its projector [degrees C]; None where the camera reports none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions:
    """How a camera that can be set is set; what is None stays as the maker's or the adapter's own.

    Attributes
    ----------
    preset
        Name of a preset of the maker, such as ``high-accuracy``.
    exposure_us
        Exposure of the depth pictures [us].
    laser_percent
        Power of the projector, as a share of its most [%].
    """

    preset: str | None = None
    exposure_us: int | None = None
    laser_percent: float | None = None

    def __bool__(self) -> bool:
        """Whether anything is set."""
        return any(getattr(self, one.name) is not None for one in fields(self))


AS_IT_IS = CameraOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedCamera:
    """A connected camera; ``uri`` is its address, which names its driver where that is not OpenNI2's."""

    uri: str
    vendor: str
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredView:
    """The view of a camera that moves depth into its colour view itself: name, size [px], field of view [rad]."""

    name: str
    size_px: tuple[int, int]
    field_of_view_rad: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FactoryCalibration:
    """The calibration that a camera has from its maker, as its SDK reports it."""

    camera: str
    serial: str
    depth: Intrinsics
    color: Intrinsics
    color_from_depth: RigidTransform


class CameraDriver(Protocol):
    """The cameras of one SDK; stateless, from any thread."""

    @property
    def prefix(self) -> str:
        """How the addresses of its cameras begin; empty for the driver of all other addresses."""

    @property
    def label(self) -> str:
        """The SDK's name in messages, such as "the OpenNI2 runtime"."""

    @property
    def warm_up_s(self) -> float:
        """How long readings of its cameras drift after their start [s]."""

    @property
    def most_noise_mm(self) -> float:
        """Noise of a training, as a motion model's, from which a camera is not as it should be [mm]."""

    @property
    def is_player(self) -> bool:
        """Whether the SDK plays recordings in real time, where it is installed."""

    @property
    def install_hint(self) -> str:
        """What an administrator does where the SDK is missing."""

    def is_installed(self) -> bool:
        """Whether the SDK is on this machine; does not try to start it."""

    def is_available(self) -> bool:
        """Whether the SDK is on this machine and starts, as far as that is known without a process for it."""

    def list_cameras(self) -> list[ListedCamera]:
        """List the connected cameras; raise RuntimeMissingError without the SDK."""

    def camera(
        self,
        uri: str | None,
        *,
        clock: Clock,
        use_registration: bool = False,
        record_to: Path | None = None,
        options: CameraOptions = AS_IT_IS,
    ) -> LiveSource:
        """Return a camera, not opened; the first one where no address is given.

        Parameters
        ----------
        options
            How it is set; a source refuses at its opening what its camera cannot be set to.
        use_registration
            Let the camera move depth into the colour camera's view.
        record_to
            Let the SDK write the frames to this ``.oni`` file too.
        """

    def player(self, path: Path, *, clock: Clock, record_to: Path | None = None) -> LiveSource | None:
        """Return what plays an ``.oni`` file in real time through the SDK; None where that cannot."""

    def registered_view(self, uri: str) -> RegisteredView | None:
        """Return the view of a camera that registers depth to colour itself; None if it cannot.

        Do not call it for a camera that a source has open: an SDK may share the device between both.

        Raises
        ------
        RuntimeMissingError, SourceLostError
            No SDK, or no such camera.
        """

    def factory_calibration(self, uri: str) -> FactoryCalibration | None:
        """Return the calibration of a camera by its maker; None where it has none. Raises as `registered_view`."""
