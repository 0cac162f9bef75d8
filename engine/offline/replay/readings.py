"""The readings of one turn of a tape, given back one by one in the order in which they were made."""

import enum
from collections.abc import Callable, Sequence
from typing import Any

from engine.core.input_tap import InputKind


class OtherReadingError(Exception):
    """Another reading is next on the tape.

    Attributes
    ----------
    name
        The kind that is next; None at the end of the turn.
    """

    def __init__(self, name: str | None) -> None:
        super().__init__(name)
        self.name = name


class RecordedReadings:
    """Readings as values; ``decode`` decodes one."""

    def __init__(self, observed: Sequence[tuple[enum.IntEnum, Any]], decode: Callable[[Any], Any]) -> None:
        self._coming, self._decode = iter(observed), decode

    def take(self, kind: InputKind) -> Any:  # noqa: ANN401 - any reading
        """Return the next value, which is of this kind; raise OtherReadingError where another reading is next."""
        following, encoded = next(self._coming, (None, None))
        if following is not kind:
            raise OtherReadingError(None if following is None else following.name)
        return self._decode(encoded)

    def rest(self) -> str | None:
        """Return the name of the next reading; None at the end."""
        following, _encoded = next(self._coming, (None, None))
        return None if following is None else following.name
