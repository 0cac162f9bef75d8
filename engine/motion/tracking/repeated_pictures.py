"""Detect repeated pictures: frames with new times whose depth or colour is old.

Two pictures of a real sensor never agree in every pixel, and two depth pictures hardly ever in more than 70 % of their
readings, however still the patient lies: a reading is whole steps of the sensor, which its noise crosses. So a picture
is old if every pixel of it was seen in one picture of the last three seconds, since a stuck driver may deliver several
buffers in turn; and a depth picture also if nearly all of its readings are those of one of them.

A picture may be old in part: a torn buffer, or one that was updated by half. So the readings are compared by tiles too:
a tile whose readings were new in nearly all pictures so far, and are all those of one earlier picture, is old.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import THIN_COLOR_PX, THIN_DEPTH_PX, Lost, LostReason, RgbdFrame, ThinViews
from engine.core.sentences import say

THINNING_PX = THIN_COLOR_PX
"""Step of the rows and columns compared first: different pictures differ there, at a hundredth of the cost."""

EARLIER_PICTURES = 96
"""Number of earlier pictures compared, by their thinned views: about three seconds, more than a driver has buffers."""

OLD_SHARE = 0.88
"""Share of a depth picture's readings that agree with those of one earlier picture, from which it is old."""

LEAST_READINGS = 200
"""Fewer readings in a thinned view do not tell a share: then only pictures that agree in every pixel are old."""

TILE_ROWS, TILE_COLUMNS = 4, 4
TILE_PX = THIN_DEPTH_PX
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

READ, SAME, LAST, NEARLY, PART = (1 << bit for bit in range(5))
"""What a picture's thinned view tells: something is read; it equals an earlier one, and the newest of them (both only
asked of fewer than `LEAST_READINGS`, and of colour); nearly all readings agree with an earlier one; the fingerprint of
a tile that changes is that of an earlier one."""

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The last pictures of one stream.

    ``repeats`` counts the repeated pictures since the last new one; ``is_in_part`` is whether only tiles of the newest
    are old; ``thin`` is the view of the newest that later checks read too.
    """

    is_depth: bool
    picture: Picture | None = None
    earlier: "_Depths | _Colors | None" = None
    timestamp_us: int | None = None
    repeats: int = 0
    is_in_part: bool = False
    thin: Picture = field(default_factory=lambda: np.empty(0, dtype=np.uint8))

    def check(self, picture: Picture, timestamp_us: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # paired with another depth frame, with its time unchanged
        self.timestamp_us = timestamp_us
        earlier = self.earlier
        if earlier is None or earlier.shape != picture.shape:
            earlier = self.earlier = _Depths.of(picture.shape) if self.is_depth else _Colors.of(picture.shape)
        seen, self.thin = earlier.look(picture), earlier.thin
        is_old = bool(seen & READ) and bool(seen & NEARLY or (seen & SAME and self._was_seen(seen, picture)))
        self.is_in_part = bool(seen & PART) and bool(seen & READ) and not is_old and earlier.has_part()
        self.picture = picture
        if is_old or self.is_in_part:
            self.repeats += 1
            return
        earlier.keep()
        self.repeats = 0

    def _was_seen(self, seen: int, picture: Picture) -> bool:
        """Whether it equals the last picture in every pixel, or the thinned view of an earlier one."""
        is_next_to_last = self.repeats == 0 and seen & LAST
        return not is_next_to_last or (self.picture is not None and np.array_equal(self.picture, picture))


@dataclass(slots=True, kw_only=True, eq=False)
class _Colors:
    """Thinned views of the last new colour pictures of one size, in a ring.

    ``thin`` is every 16th row and column of the newest, and ``view`` the same as one row.
    """

    shape: tuple[int, ...]
    views: npt.NDArray[np.uint8]
    view: npt.NDArray[np.uint8]
    thin: Picture
    oldest: int = 0

    @staticmethod
    def of(shape: tuple[int, ...]) -> "_Colors":
        """Make an empty ring."""
        thin = np.zeros((*[-(-side // THINNING_PX) for side in shape[:2]], *shape[2:]), dtype=np.uint8)
        views = np.zeros((EARLIER_PICTURES, thin.size), dtype=np.uint8)
        return _Colors(shape=shape, views=views, view=thin.reshape(-1), thin=thin)

    def look(self, picture: Picture) -> int:
        """Return what the thinned view of a picture tells."""
        newest, compiled = (self.oldest - 1) % EARLIER_PICTURES, FramePath.kernels
        if compiled is not None:
            seen: int = compiled.look_at_color(
                np.ascontiguousarray(picture), THINNING_PX, self.views, newest, self.view
            )
            return seen
        self.view[:] = picture[::THINNING_PX, ::THINNING_PX].ravel()
        return READ * bool(self.view.any()) | _equal(self.views, self.view, newest)

    def has_part(self) -> bool:
        """Return False: only depth is compared by tiles."""
        return False

    def keep(self) -> None:
        """Keep the newest view in place of the oldest."""
        self.views[self.oldest] = self.view
        self.oldest = (self.oldest + 1) % EARLIER_PICTURES


def _equal(earlier: Picture, view: Picture, newest: int) -> int:
    """Return whether a view equals an earlier one, and the newest of them."""
    are_equal = (earlier == view).all(axis=1)
    return SAME * bool(are_equal.any()) | LAST * bool(are_equal[newest])


@dataclass(slots=True, kw_only=True, eq=False)
class _Depths:
    """The last new depth pictures of one size, in rings of `EARLIER_PICTURES`.

    ``readings`` are their thinned views, ``prints`` fingerprints of these by tile, ``tiles`` less thinned views;
    ``row``, ``marks`` and ``thin`` are the same of the picture that is looked at. ``new_share``, over ``compared``
    pictures, is the share of those in the last second in which a tile was new.
    """

    shape: tuple[int, ...]
    places: "_Places"
    readings: npt.NDArray[np.uint16]
    prints: npt.NDArray[np.int64]
    tiles: list[npt.NDArray[np.uint16]]
    row: npt.NDArray[np.uint16]
    marks: npt.NDArray[np.int64]
    thin: npt.NDArray[np.uint16]
    new_share: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(TILE_ROWS * TILE_COLUMNS))
    oldest: int = 0
    compared: int = -1

    @staticmethod
    def of(shape: tuple[int, ...]) -> "_Depths":
        """Make empty rings."""
        places = _Places.of(shape)
        size, tiles = places.tile_of.size, TILE_ROWS * TILE_COLUMNS
        views = np.zeros((EARLIER_PICTURES + 1, *[-(-side // TILE_PX) for side in shape]), dtype=np.uint16)
        return _Depths(
            shape=shape,
            places=places,
            readings=np.zeros((EARLIER_PICTURES, size), dtype=np.uint16),
            prints=np.zeros((EARLIER_PICTURES, tiles), dtype=np.int64),
            tiles=list(views[1:]),
            row=np.zeros(size, dtype=np.uint16),
            marks=np.zeros(tiles, dtype=np.int64),
            thin=views[0],
        )

    def look(self, picture: Picture) -> int:
        """Return what the thinned view of a picture tells."""
        newest, compiled = (self.oldest - 1) % EARLIER_PICTURES, FramePath.kernels
        if compiled is None:
            return self._look(picture, newest)
        seen: int = compiled.look_at_depth(
            np.ascontiguousarray(picture),
            THINNING_PX,
            TILE_PX,
            self.places.tile_of,
            self.places.weights,
            self.readings,
            self.prints,
            self.new_share,
            newest,
            LEAST_READINGS,
            OLD_SHARE,
            NEW_SHARE,
            self.row,
            self.marks,
            self.thin,
        )
        return seen

    def _look(self, picture: Picture, newest: int) -> int:
        """Return the same with numpy."""
        self.row[:] = picture[::THINNING_PX, ::THINNING_PX].ravel()
        self.thin[:] = picture[::TILE_PX, ::TILE_PX]
        self.marks[:] = 0
        np.add.at(self.marks, self.places.tile_of, self.row * self.places.weights)
        count = int(np.count_nonzero(self.row))
        if count < LEAST_READINGS:
            found = _equal(self.readings, self.row, newest)
        else:
            different = np.count_nonzero((self.readings != self.row) & (self.row > 0), axis=1)
            found = NEARLY * bool(different.min() <= count - math.ceil(OLD_SHARE * count - 1e-9))
        are_known = (self.new_share >= NEW_SHARE) & (self.marks != 0)
        found |= PART * bool(((self.prints == self.marks) & are_known).any())
        return READ * (count > 0) | found

    def has_part(self) -> bool:
        """Whether a tile's readings are all those of an earlier picture, of tiles that are known to change."""
        if self.compared < LEAST_COMPARED or np.count_nonzero(self.row) < LEAST_READINGS:
            return False
        is_like = (self.prints == self.marks) & (self.new_share >= NEW_SHARE)
        newest_first = (self.oldest - 1 - np.arange(EARLIER_PICTURES)) % EARLIER_PICTURES
        found = is_like[newest_first]
        return any(
            self._tile_agrees(int(newest_first[found[:, tile].argmax()]), int(tile))
            for tile in np.flatnonzero(found.any(axis=0))
        )

    def _tile_agrees(self, slot: int, tile: int) -> bool:
        rows, columns = self.places.tiles[tile]
        now, before = self.thin[rows, columns], self.tiles[slot][rows, columns]
        is_read = now > 0
        count = np.count_nonzero(is_read)
        return bool(count >= LEAST_OF_A_TILE and np.count_nonzero((now == before) & is_read) >= OLD_TILE_SHARE * count)

    def keep(self) -> None:
        """Keep the newest picture in place of the oldest; note which of its tiles are new against the one before."""
        slot, before = self.oldest, (self.oldest - 1) % EARLIER_PICTURES
        self.compared += 1
        if self.compared > 0:
            are_new = self.prints[before] != self.marks
            if not np.logical_and.reduce(are_new):
                for tile in np.flatnonzero(~are_new):
                    are_new[tile] = not self._tile_agrees(before, int(tile))
            self.new_share += max(NEW_WEIGHT, 1.0 / self.compared) * (are_new - self.new_share)
        self.readings[slot] = self.row
        self.prints[slot] = self.marks
        self.tiles[slot], self.thin = self.thin, self.tiles[slot]
        self.oldest = (slot + 1) % EARLIER_PICTURES


class _Places(NamedTuple):
    """Where the tiles of pictures of one size are.

    ``tile_of`` is the tile of each reading of the thinned view, ``weights`` are what its fingerprint weighs each with;
    ``tiles`` are the rows and columns of each in the view of every fourth row and column.
    """

    tile_of: npt.NDArray[np.intp]
    weights: npt.NDArray[np.int64]
    tiles: tuple[tuple[slice, slice], ...]

    @staticmethod
    def of(shape: tuple[int, ...]) -> "_Places":
        """Divide a picture."""
        rows, columns = (np.arange(0, size, THINNING_PX) for size in shape[:2])
        row_tile, column_tile = rows * TILE_ROWS // shape[0], columns * TILE_COLUMNS // shape[1]
        number = (row_tile[:, None] * TILE_COLUMNS + column_tile).ravel()
        weights = np.random.default_rng(1).integers(-(2**63), 2**63, number.size, dtype=np.int64) | 1
        row_slices, column_slices = (
            [_slice(size, step, steps) for step in range(steps)]
            for size, steps in zip(shape[:2], (TILE_ROWS, TILE_COLUMNS), strict=True)
        )
        tiles = tuple((row, column) for row in row_slices for column in column_slices)
        return _Places(number, weights, tiles)


def _slice(size: int, step: int, steps: int) -> slice:
    """Return where a tile lies along an axis in the view of every fourth pixel."""
    first, last = (-(-at * size // (steps * TILE_PX)) for at in (step, step + 1))
    return slice(first, last)


class RepeatedPictures:
    """Compares each picture with earlier ones; owned by one thread."""

    def __init__(self) -> None:
        self._streams = {say("depth"): _Stream(is_depth=True), say("colour"): _Stream(is_depth=False)}

    @property
    def thin(self) -> ThinViews:
        """The views of the frame that was checked last."""
        depth, color = self._streams.values()
        return ThinViews(depth.thin, color.thin)  # type: ignore[arg-type]

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
