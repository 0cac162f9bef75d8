"""A virtual camera of known latency with a light in view: for demonstration and for tests."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from engine.capture.source import SourceDescription
from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.errors import SourceEndedError
from engine.core.frames import FloatArray, RgbdFrame
from engine.qa.latency.light_driver import LightChange, intervals_ns
from engine.qa.latency.measure import LEAD_S, LightInput

BEGINS_NS = 100 * NS_PER_S
PERIOD_MS = 33.366
ROWS, COLUMNS = 60, 80
ROOM_LIGHT, LIGHT_STEP = 80.0, 90.0
DISTANCE_MM = 850.0
SUBTIMES = np.linspace(-0.5, 0.5, 33)


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualFaults:
    """How the virtual camera deviates.

    Attributes
    ----------
    delay_ms
        From the middle of the exposure to the receipt of the promptest frame [ms].
    exposure_ms, jitter_ms
        Length of the exposure, and mean further delay of a frame [ms].
    clock_ppm
        How much faster than the host's the camera's clock runs [ppm].
    lost_share
        Share of the frames that the camera loses, 0 to 1.
    flicker
        Amplitude of the room light's flicker, of 255.
    room_light
        Brightness without the light, of 255.
    light_step
        The light's own brightness, of 255; 0 is a light that is out of view.
    is_stuck
        Whether the light stays on.
    """

    delay_ms: float = 0.0
    exposure_ms: float = 8.0
    jitter_ms: float = 1.0
    clock_ppm: float = 40.0
    lost_share: float = 0.0
    flicker: float = 0.0
    room_light: float = ROOM_LIGHT
    light_step: float = LIGHT_STEP
    is_stuck: bool = False


class KnownLight:
    """A light whose changes happened at known times; nothing is driven."""

    def __init__(self, changes: Sequence[LightChange]) -> None:
        self.changes = tuple(changes)
        self.failure = ""

    @contextmanager
    def driving(self) -> Iterator[None]:
        """Do nothing."""
        yield


class VirtualCamera:
    """A DepthSource without waiting: frames of a flat wall, with a light in one corner."""

    def __init__(
        self,
        faults: VirtualFaults,
        *,
        seed: int,
        seconds: float,
        light_ns: FloatArray,
    ) -> None:
        self._faults, self._light_ns = faults, light_ns
        self._seed, self._count = seed, int(1000.0 * seconds / PERIOD_MS)
        self._frames: Iterator[RgbdFrame] = iter(())
        self.description = SourceDescription(
            kind="virtual",
            name="virtual camera",
            depth_size=(COLUMNS, ROWS),
            color_size=(COLUMNS, ROWS),
            fps=30.0,
            is_live=True,
            serial="VIRTUAL",
        )

    def open(self) -> SourceDescription:
        """Begin at the first frame."""
        self._frames = self._made()
        return self.description

    def read(self, timeout_s: float) -> RgbdFrame:  # noqa: ARG002
        """Return the next frame at once; raise SourceEndedError after the last."""
        frame = next(self._frames, None)
        if frame is None:
            msg = "the virtual camera has no more frames"
            raise SourceEndedError(msg)
        return frame

    def close(self) -> None:
        """Do nothing."""

    def _made(self) -> Iterator[RgbdFrame]:
        faults, chance = self._faults, np.random.default_rng(self._seed)
        at_ns, index, missed = 0, 0, 0
        for number in range(self._count):
            exposed_ns = int(number * PERIOD_MS * NS_PER_MS)
            late_ms = faults.delay_ms + chance.exponential(max(faults.jitter_ms, 1e-9))
            is_lost = index > 0 and chance.random() < faults.lost_share
            missed += is_lost
            if is_lost:
                continue
            at_ns = max(at_ns + 1, BEGINS_NS + exposed_ns + int(late_ms * NS_PER_MS))
            stamp_us = round(exposed_ns * (1.0 + 1e-6 * faults.clock_ppm) / 1000) + 7_000_000
            yield RgbdFrame(
                index=index,
                device_index=number,
                missed_frames=missed,
                timestamp_us=stamp_us,
                color_timestamp_us=stamp_us,
                received_ns=at_ns,
                queue_empty_ns=at_ns,
                depth_mm=_depth(chance),
                color=self._color(exposed_ns, number, chance),
            )
            index, missed = index + 1, 0

    def _color(self, exposed_ns: int, number: int, chance: np.random.Generator) -> np.ndarray:
        faults = self._faults
        picture = faults.room_light + chance.normal(0.0, 1.5, (ROWS, COLUMNS))
        picture += faults.flicker * np.sin(2.1 * number)
        within_ns = BEGINS_NS + exposed_ns + SUBTIMES * faults.exposure_ms * NS_PER_MS
        share = float(np.mean(np.searchsorted(self._light_ns, within_ns) % 2))
        picture[20, 30] += faults.light_step * (1.0 if faults.is_stuck else share)
        return np.repeat(np.clip(np.round(picture), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def virtual_light(faults: VirtualFaults, *, seed: int, seconds: float = 60.0) -> LightInput:
    """Return a virtual camera with a light whose changes are known exactly."""
    begins_ns = BEGINS_NS + NS_PER_S
    at_ns = begins_ns + np.cumsum(np.array(intervals_ns(seed, seconds - LEAD_S), dtype=np.int64))
    changes = [
        LightChange(is_on=number % 2 == 0, earliest_ns=at, latest_ns=at) for number, at in enumerate(at_ns.tolist())
    ]
    camera = VirtualCamera(faults, seed=seed, seconds=seconds, light_ns=at_ns.astype(np.float64))
    return LightInput(
        source=camera, camera=camera.description, light=KnownLight(changes), output_ms=0.0, seconds=seconds
    )


def _depth(chance: np.random.Generator) -> np.ndarray:
    return np.round(DISTANCE_MM + chance.normal(0.0, 1.0, (ROWS, COLUMNS))).astype(np.uint16)
