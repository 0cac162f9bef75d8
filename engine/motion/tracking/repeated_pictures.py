"""Detect repeated pictures: frames with new times whose depth or colour is old.

Two pictures of a real sensor never agree in every pixel, and two depth pictures hardly ever in more than 70 % of their
readings, however still the patient lies: a reading is whole steps of the sensor, which its noise crosses. So a picture
is old if every pixel of it was seen in one picture of the last three seconds, since a stuck driver may deliver several
buffers in turn; and a depth picture also if nearly all of its readings are those of one of them.

A picture may be old in part: a torn buffer, or one that was updated by half. So the readings are compared by tiles too:
a tile whose readings were new in nearly all pictures so far, and are all those of one earlier picture, is old.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import Lost, LostReason, RgbdFrame
from engine.core.sentences import say

THINNING_PX = 16
"""Step of the rows and columns compared first: different pictures differ there, at a hundredth of the cost."""

EARLIER_PICTURES = 96
"""Number of earlier pictures compared, by their thinned views: about three seconds, more than a driver has buffers."""

OLD_SHARE = 0.88
"""Share of a depth picture's readings that agree with those of one earlier picture, from which it is old."""

LEAST_READINGS = 200
"""Fewer readings in a thinned view do not tell a share: then only pictures that agree in every pixel are old."""

TILE_ROWS, TILE_COLUMNS = 4, 4
TILE_PX = 4
"""Step of the rows and columns by which a tile that may be old is looked at again."""
OLD_TILE_SHARE = 0.995
"""Share of a tile's readings that agree with an earlier picture, from which it is old: of a still wall three metres
away 0.95 do, of a chest 0.7."""
LEAST_OF_A_TILE = 200
"""Fewest readings of a tile that tell anything."""
LEAST_COMPARED = 10
"""Fewest pictures that were compared with the one before, by which a tile is known to change."""
NEW_SHARE, NEW_WEIGHT = 0.9, 1.0 / 30.0
"""Share of the last second's pictures in which a tile has to have been new: one that hardly ever is, such as that of a
plate, tells nothing."""

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The last pictures of one stream.

    ``repeats`` counts the repeated pictures since the last new one; ``is_in_part`` is whether only tiles of the newest
    are old. ``views`` holds the thinned views of the last new pictures.
    """

    is_depth: bool
    picture: Picture | None = None
    views: deque[bytes] = field(default_factory=lambda: deque(maxlen=EARLIER_PICTURES))
    depths: "_Depths | None" = None
    timestamp_us: int | None = None
    repeats: int = 0
    is_in_part: bool = False

    def check(self, picture: Picture, timestamp_us: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # paired with another depth frame, with its time unchanged
        self.timestamp_us = timestamp_us
        depths = self._depths_of(picture.shape) if self.is_depth else None
        readings = picture[::THINNING_PX, ::THINNING_PX].flatten() if depths is None else depths.thinned(picture)
        view = readings.tobytes()
        is_read = any(view)
        is_old = is_read and (self._was_seen(view, picture) or (depths is not None and depths.has_nearly(readings)))
        prints = None if depths is None else depths.places.prints(readings)
        self.is_in_part = (
            depths is not None and prints is not None and is_read and not is_old and depths.has_part(readings, prints)
        )
        self.picture = picture
        if is_old or self.is_in_part:
            self.repeats += 1
            return
        self.views.append(view)
        if depths is not None and prints is not None:
            depths.keep(readings, prints)
        self.repeats = 0

    def _was_seen(self, view: bytes, picture: Picture) -> bool:
        """Whether it equals the last picture in every pixel, or the thinned view of an earlier one."""
        if view not in self.views:
            return False
        is_next_to_last = self.repeats == 0 and view == self.views[-1]
        return not is_next_to_last or (self.picture is not None and np.array_equal(self.picture, picture))

    def _depths_of(self, shape: tuple[int, ...]) -> "_Depths":
        if self.depths is None or self.depths.places.shape != shape:
            self.depths = _Depths(places=_Places.of(shape))
        return self.depths


@dataclass(slots=True, kw_only=True)
class _Depths:
    """The last new depth pictures of one size, in rings of `EARLIER_PICTURES`.

    ``newest`` is the less thinned view of the picture that is looked at.

    ``readings`` are their thinned views, ``prints`` fingerprints of these by tile, and ``tiles`` less thinned views.
    ``new_share``, over ``compared`` pictures, is the share of those in the last second in which a tile was new.
    """

    places: "_Places"
    readings: Picture = field(init=False)
    prints: npt.NDArray[np.uint64] = field(init=False)
    tiles: Picture = field(init=False)
    newest: Picture = field(init=False)
    new_share: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(TILE_ROWS * TILE_COLUMNS))
    oldest: int = 0
    compared: int = -1

    def __post_init__(self) -> None:
        """Make the rings."""
        self.readings = np.zeros((EARLIER_PICTURES, self.places.order.size), dtype=np.uint16)
        self.prints = np.zeros((EARLIER_PICTURES, TILE_ROWS * TILE_COLUMNS), dtype=np.uint64)
        shape = [-(-size // TILE_PX) for size in self.places.shape]
        self.tiles = np.zeros((EARLIER_PICTURES, *shape), dtype=np.uint16)
        self.newest = np.zeros(shape, dtype=np.uint16)

    def thinned(self, picture: Picture) -> Picture:
        """Look at a picture; return its thinned view, shape (readings,)."""
        compiled = FramePath.kernels
        if compiled is None:
            self.newest[:] = picture[::TILE_PX, ::TILE_PX]
        else:
            compiled.thin(np.ascontiguousarray(picture), TILE_PX, self.newest)
        return self.newest[:: THINNING_PX // TILE_PX, :: THINNING_PX // TILE_PX].flatten()

    def has_nearly(self, readings: Picture) -> bool:
        """Whether nearly all readings of a picture agree with those of one of the last new ones."""
        count = int(np.count_nonzero(readings))
        if count < LEAST_READINGS:
            return False
        most_different = count - math.ceil(OLD_SHARE * count - 1e-9)
        compiled = FramePath.kernels
        if compiled is not None:
            return bool(compiled.differs_little(self.readings, readings, most_different))
        different = (self.readings != readings) & (readings > 0)
        return bool(np.count_nonzero(different, axis=1).min() <= most_different)

    def has_part(self, readings: Picture, prints: npt.NDArray[np.uint64]) -> bool:
        """Whether a tile's readings are all those of an earlier picture, of tiles that are known to change."""
        if self.compared < LEAST_COMPARED:
            return False
        is_like = (self.prints == prints) & (self.new_share >= NEW_SHARE)
        if not is_like.any() or np.count_nonzero(readings) < LEAST_READINGS:
            return False
        newest_first = (self.oldest - 1 - np.arange(EARLIER_PICTURES)) % EARLIER_PICTURES
        found = is_like[newest_first]
        return any(
            self._tile_agrees(int(newest_first[found[:, tile].argmax()]), int(tile))
            for tile in np.flatnonzero(found.any(axis=0))
        )

    def _tile_agrees(self, slot: int, tile: int) -> bool:
        rows, columns = self.places.tiles[tile]
        now, before = self.newest[rows, columns], self.tiles[slot, rows, columns]
        is_read = now > 0
        count = np.count_nonzero(is_read)
        return bool(count >= LEAST_OF_A_TILE and np.count_nonzero((now == before) & is_read) >= OLD_TILE_SHARE * count)

    def keep(self, readings: Picture, prints: npt.NDArray[np.uint64]) -> None:
        """Keep the newest picture in place of the oldest; note which of its tiles are new against the one before."""
        before = (self.oldest - 1) % EARLIER_PICTURES
        self.compared += 1
        if self.compared > 0:
            is_new = self.prints[before] != prints
            if not is_new.all():
                for tile in np.flatnonzero(~is_new):
                    is_new[tile] = not self._tile_agrees(before, int(tile))
            self.new_share += max(NEW_WEIGHT, 1.0 / self.compared) * (is_new - self.new_share)
        self.readings[self.oldest] = readings
        self.prints[self.oldest] = prints
        self.tiles[self.oldest] = self.newest
        self.oldest = (self.oldest + 1) % EARLIER_PICTURES


class _Places(NamedTuple):
    """Where the tiles of pictures of one size are.

    ``order`` brings the readings of the thinned view tile by tile, ``firsts`` is where each tile begins in it, and
    ``weights`` are what a fingerprint weighs each reading with; ``tiles`` are the rows and columns of each in the view
    of every fourth row and column.
    """

    shape: tuple[int, ...]
    order: npt.NDArray[np.intp]
    firsts: npt.NDArray[np.intp]
    weights: npt.NDArray[np.uint64]
    tiles: tuple[tuple[slice, slice], ...]

    @staticmethod
    def of(shape: tuple[int, ...]) -> "_Places":
        """Divide a picture."""
        rows, columns = (np.arange(0, size, THINNING_PX) for size in shape[:2])
        row_tile, column_tile = rows * TILE_ROWS // shape[0], columns * TILE_COLUMNS // shape[1]
        number = (row_tile[:, None] * TILE_COLUMNS + column_tile).ravel()
        order = np.argsort(number, kind="stable")
        counts = np.bincount(number, minlength=TILE_ROWS * TILE_COLUMNS)
        firsts = np.minimum(np.cumsum(counts) - counts, number.size - 1)
        weights = np.random.default_rng(1).integers(0, 2**64, number.size, dtype=np.uint64) | np.uint64(1)
        row_slices, column_slices = (
            [_slice(size, step, steps) for step in range(steps)]
            for size, steps in zip(shape[:2], (TILE_ROWS, TILE_COLUMNS), strict=True)
        )
        tiles = tuple((row, column) for row in row_slices for column in column_slices)
        return _Places(shape, order, firsts, weights, tiles)

    def prints(self, readings: Picture) -> npt.NDArray[np.uint64]:
        """Return a fingerprint of each tile's thinned readings; equal ones are looked at again, reading by reading."""
        return np.add.reduceat(readings[self.order] * self.weights, self.firsts)


def _slice(size: int, step: int, steps: int) -> slice:
    """Return where a tile lies along an axis in the view of every fourth pixel."""
    first, last = (-(-at * size // (steps * TILE_PX)) for at in (step, step + 1))
    return slice(first, last)


class RepeatedPictures:
    """Compares each picture with earlier ones; owned by one thread."""

    def __init__(self) -> None:
        self._streams = {say("depth"): _Stream(is_depth=True), say("colour"): _Stream(is_depth=False)}

    def check(self, frame: RgbdFrame) -> Lost | None:
        """Return the loss of a frame whose depth or colour picture is old: its values are those of another moment."""
        depth, color = self._streams.values()
        depth.check(frame.depth_mm, frame.timestamp_us)
        color.check(frame.color, frame.color_timestamp_us)
        for name, stream in self._streams.items():
            if stream.repeats > 0 and stream.is_in_part:
                detail = say("a part of the {name} picture is repeated ({repeats})", name=name, repeats=stream.repeats)
                return Lost(reason=LostReason.FRAME_TORN, detail=detail)
            if stream.repeats > 0:
                detail = say("the {name} picture is repeated ({repeats})", name=name, repeats=stream.repeats)
                return Lost(reason=LostReason.FRAME_FROZEN, detail=detail)
        return None
