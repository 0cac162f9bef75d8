"""What every serial line has in common: its speeds and parities, each bounded to what boards and cables know."""

from typing import Literal, TypeAlias

from engine.errors import InvalidValueError

BAUD_RATES = (9_600, 19_200, 38_400, 57_600, 115_200)
Parity: TypeAlias = Literal["none", "even", "odd"]
PARITY_LETTERS: dict[Parity, str] = {"none": "N", "even": "E", "odd": "O"}


def check_baud(baud: int) -> None:
    """Refuse a speed that is none of the usual; raise InvalidValueError."""
    if baud not in BAUD_RATES:
        raise InvalidValueError("baud", baud, f"one of {', '.join(map(str, BAUD_RATES))}")
