"""Detect repeated pictures: frames with new times whose depth or colour is old.

Two pictures of a real sensor never agree in every pixel, and two depth pictures hardly ever in more than 70 % of their
readings, however still the patient lies: a reading is whole steps of the sensor, which its noise crosses. So a picture
is old if every pixel of it was seen in one picture of the last three seconds, since a stuck driver may deliver several
buffers in turn; and a depth picture also if nearly all of its readings are those of one of them.

A picture may be old in part: a torn buffer, or one that was updated by half. So the readings are compared by tiles too:
a tile whose readings were new in nearly all pictures so far, and are all those of one earlier picture, is old.
"""

import itertools
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

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
    are old. ``views`` holds the thinned views of the last new
    pictures, and ``readings`` those of depth, shape (pictures, readings). Of depth also: ``tiles`` are its less thinned
    views, ``pieces`` the thinned readings of the newest picture tile by tile, ``slots`` the newest picture that had the
    same, and ``new_share``, over ``compared`` pictures, the share of those in the last second in which a tile was new.
    """

    is_depth: bool
    picture: Picture | None = None
    views: deque[bytes] = field(default_factory=lambda: deque(maxlen=EARLIER_PICTURES))
    readings: Picture | None = None
    oldest: int = 0
    timestamp_us: int | None = None
    repeats: int = 0
    is_in_part: bool = False
    tiles: "list[Picture | None]" = field(default_factory=lambda: [None] * EARLIER_PICTURES)
    pieces: tuple[bytes, ...] = ()
    kept_pieces: deque[tuple[bytes, ...]] = field(default_factory=deque)
    slots: dict[tuple[int, bytes], int] = field(default_factory=dict)
    new_share: list[float] = field(default_factory=lambda: [0.0] * (TILE_ROWS * TILE_COLUMNS))
    compared: int = 0
    places: "_Places | None" = None

    def check(self, picture: Picture, timestamp_us: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # paired with another depth frame, with its time unchanged
        self.timestamp_us = timestamp_us
        readings = picture[::THINNING_PX, ::THINNING_PX].flatten()
        view = readings.tobytes()
        if self.is_depth:
            self.pieces = self._pieces(readings, picture)
        is_old = any(view) and (self._was_seen(view, picture) or (self.is_depth and self._is_nearly_old(readings)))
        self.is_in_part = self.is_depth and not is_old and any(view) and self._is_old_in_part(readings, picture)
        self.picture = picture
        if is_old or self.is_in_part:
            self.repeats += 1
            return
        self.views.append(view)
        if self.is_depth:
            self._keep(readings, picture)
        self.repeats = 0

    def _was_seen(self, view: bytes, picture: Picture) -> bool:
        """Whether it equals the last picture in every pixel, or the thinned view of an earlier one."""
        if view not in self.views:
            return False
        is_next_to_last = self.repeats == 0 and view == self.views[-1]
        return not is_next_to_last or (self.picture is not None and np.array_equal(self.picture, picture))

    def _comparable(self, readings: Picture) -> Picture | None:
        """Return the readings of the last new pictures; None of another size, or where there is too little to tell."""
        if self.readings is None or self.readings.shape[1] != readings.size:
            return None
        return self.readings if np.count_nonzero(readings) >= LEAST_READINGS else None

    def _is_nearly_old(self, readings: Picture) -> bool:
        """Whether nearly all of its readings agree with those of one of the last new pictures."""
        earlier = self._comparable(readings)
        if earlier is None:
            return False
        is_read = (readings > 0).astype(np.float32)
        # A product of matrices counts the agreeing readings twice as fast as a sum of booleans does.
        agreeing = (earlier == readings).astype(np.float32) @ is_read
        return bool(agreeing.max() >= OLD_SHARE * is_read.sum())

    def _is_old_in_part(self, readings: Picture, picture: Picture) -> bool:
        """Whether a tile's readings are all those of an earlier picture, of tiles that are known to change."""
        if self.compared < LEAST_COMPARED or self._comparable(readings) is None:
            return False
        found = ((tile, self.slots.get((tile, piece))) for tile, piece in enumerate(self.pieces))
        return any(
            slot is not None and self.new_share[tile] >= NEW_SHARE and self._tile_agrees(slot, tile, picture)
            for tile, slot in found
        )

    def _tile_agrees(self, slot: int, tile: int, picture: Picture) -> bool:
        earlier = self.tiles[slot]
        if earlier is None or self.places is None:
            return False
        rows, columns = self.places.tiles[tile]
        now, before = picture[::TILE_PX, ::TILE_PX][rows, columns], earlier[rows, columns]
        is_read = now > 0
        count = np.count_nonzero(is_read)
        return bool(count >= LEAST_OF_A_TILE and np.count_nonzero((now == before) & is_read) >= OLD_TILE_SHARE * count)

    def _keep(self, readings: Picture, picture: Picture) -> None:
        """Keep the readings of a new picture in place of the oldest."""
        if self.readings is None or self.readings.shape[1] != readings.size:
            self.readings = np.zeros((EARLIER_PICTURES, readings.size), dtype=readings.dtype)
            self.oldest = self.compared = 0
            self.tiles, self.new_share = [None] * EARLIER_PICTURES, [0.0] * (TILE_ROWS * TILE_COLUMNS)
            self.slots.clear()
            self.kept_pieces.clear()
        pieces = self.pieces
        if self.kept_pieces:
            self._note_changes(pieces, picture)
        if len(self.kept_pieces) == EARLIER_PICTURES:
            for tile, piece in enumerate(self.kept_pieces.popleft()):
                if self.slots.get((tile, piece)) == self.oldest:
                    del self.slots[tile, piece]
        self.kept_pieces.append(pieces)
        self.slots.update(dict.fromkeys(enumerate(pieces), self.oldest))
        self.readings[self.oldest] = readings
        self.tiles[self.oldest] = picture[::TILE_PX, ::TILE_PX].copy()
        self.oldest = (self.oldest + 1) % EARLIER_PICTURES

    def _note_changes(self, pieces: tuple[bytes, ...], picture: Picture) -> None:
        """Note which tiles are new against the picture before."""
        before, slot = self.kept_pieces[-1], (self.oldest - 1) % EARLIER_PICTURES
        self.compared += 1
        weight = max(NEW_WEIGHT, 1.0 / self.compared)
        for tile, piece in enumerate(pieces):
            is_new = piece != before[tile] or not self._tile_agrees(slot, tile, picture)
            self.new_share[tile] += weight * (is_new - self.new_share[tile])

    def _pieces(self, readings: Picture, picture: Picture) -> tuple[bytes, ...]:
        """Return the thinned readings of each tile."""
        if self.places is None or self.places.shape != picture.shape:
            self.places = _Places.of(picture.shape)
        places = self.places
        content = readings[places.order].tobytes()
        at = [end * readings.itemsize for end in places.ends]
        return tuple(content[first:last] for first, last in itertools.pairwise((0, *at)))


class _Places(NamedTuple):
    """Where the tiles of pictures of one size are.

    ``order`` brings the readings of the thinned view tile by tile, and ``ends`` is where each tile ends in it;
    ``tiles`` are the rows and columns of each in the view of every fourth row and column.
    """

    shape: tuple[int, ...]
    order: npt.NDArray[np.intp]
    ends: tuple[int, ...]
    tiles: tuple[tuple[slice, slice], ...]

    @staticmethod
    def of(shape: tuple[int, ...]) -> "_Places":
        """Divide a picture."""
        rows, columns = (np.arange(0, size, THINNING_PX) for size in shape[:2])
        row_tile, column_tile = rows * TILE_ROWS // shape[0], columns * TILE_COLUMNS // shape[1]
        number = (row_tile[:, None] * TILE_COLUMNS + column_tile).ravel()
        order = np.argsort(number, kind="stable")
        ends = np.cumsum(np.bincount(number, minlength=TILE_ROWS * TILE_COLUMNS))
        row_slices, column_slices = (
            [_slice(size, step, steps) for step in range(steps)]
            for size, steps in zip(shape[:2], (TILE_ROWS, TILE_COLUMNS), strict=True)
        )
        tiles = tuple((row, column) for row in row_slices for column in column_slices)
        return _Places(shape, order, tuple(ends.tolist()), tiles)


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
