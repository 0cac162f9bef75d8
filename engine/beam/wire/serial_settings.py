"""Speeds and parities of serial lines."""

from typing import Literal, TypeAlias

from engine.core.errors import InvalidValueError

BAUD_RATES = (9_600, 19_200, 38_400, 57_600, 115_200)
Parity: TypeAlias = Literal["none", "even", "odd"]
PARITY_LETTERS: dict[Parity, str] = {"none": "N", "even": "E", "odd": "O"}


def check_baud(baud: int) -> None:
    """Raise InvalidValueError for a speed that is not in `BAUD_RATES`."""
    if baud not in BAUD_RATES:
        raise InvalidValueError("baud", baud, f"one of {', '.join(map(str, BAUD_RATES))}")
