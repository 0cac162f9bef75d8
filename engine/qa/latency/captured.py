"""What the latency is estimated from: the times of the frames, and the brightness of each colour picture."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import FloatArray, RgbdFrame

Times = npt.NDArray[np.int64]
BLOCKS_ACROSS, BLOCKS_DOWN = 80, 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTimes:
    """Times of the depth frames: of the device [us] and of the receipt [ns, host], shape (n,); lost frames in all."""

    device_us: Times
    received_ns: Times
    missed_frames: int

    @property
    def period_ms(self) -> float:
        """Median time between two frames [ms]."""
        return float(np.median(np.diff(self.device_us))) / 1e3

    @property
    def missed_share(self) -> float:
        """Share of the frames that the camera did not deliver, 0 to 1."""
        return self.missed_frames / (self.missed_frames + len(self.device_us))


class TimeLog:
    """Collects the times of frames."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int]] = []
        self._missed = 0

    def add(self, frame: RgbdFrame) -> None:
        """Add one frame."""
        self._rows.append((frame.timestamp_us, frame.received_ns))
        self._missed += frame.missed_frames if len(self._rows) > 1 else 0

    @property
    def times(self) -> FrameTimes:
        """The times so far."""
        device_us, received_ns = np.array(self._rows, dtype=np.int64).reshape(-1, 2).T.copy()
        return FrameTimes(device_us=device_us, received_ns=received_ns, missed_frames=self._missed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pictures:
    """Colour pictures as mean brightness of blocks.

    Attributes
    ----------
    device_us
        Device time of each colour picture [us], increasing, shape (n,).
    blocks
        Mean brightness of each block, 0 to 255, shape (n, rows, columns).
    """

    device_us: Times
    blocks: FloatArray


class PictureLog:
    """Collects colour pictures; one that comes with two depth frames counts once."""

    def __init__(self) -> None:
        self._times_us: list[int] = []
        self._blocks: list[FloatArray] = []

    def add(self, frame: RgbdFrame) -> None:
        """Add the colour picture of one frame."""
        if self._times_us and frame.color_timestamp_us <= self._times_us[-1]:
            return
        gray = cv2.cvtColor(np.asarray(frame.color), cv2.COLOR_RGB2GRAY).astype(np.float32)
        size = min(BLOCKS_ACROSS, gray.shape[1]), min(BLOCKS_DOWN, gray.shape[0])
        self._times_us.append(frame.color_timestamp_us)
        self._blocks.append(np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.float32))

    @property
    def pictures(self) -> Pictures:
        """The pictures so far."""
        return Pictures(device_us=np.array(self._times_us, dtype=np.int64), blocks=np.array(self._blocks))
