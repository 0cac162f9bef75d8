"""Range checks for settings and requests; each refusal names the field, the value and the bound."""

from collections.abc import Mapping

from engine.core.errors import InvalidValueError


def check_number(
    name: str,
    value: object,
    low: float,
    high: float,
    note: str = "",
    *,
    error: type[InvalidValueError] = InvalidValueError,
) -> float:
    """Return ``value`` as a float; raise ``error`` for NaN, a bool, no number, or one outside [low, high].

    ``note`` ends the sentence: a unit, or what the bound depends on.
    """
    # Written so that NaN fails: every comparison with it is false. Compared before the conversion: a whole number of a
    # thousand digits has no float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise error(name, value, f"a number from {low:g} to {high:g} {note}".rstrip())
    return float(value)


def check_whole_number(
    name: str,
    value: object,
    low: int,
    high: int,
    note: str = "",
    *,
    error: type[InvalidValueError] = InvalidValueError,
) -> int:
    """Return ``value``; raise ``error`` for a bool, no whole number, or one outside [low, high]."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise error(name, value, f"a whole number from {low} to {high} {note}".rstrip())
    return value


def check_numbers(values: object, bounds: Mapping[str, tuple[float, float]]) -> None:
    """Check the attributes named in ``bounds`` against their lowest and highest value; raise InvalidValueError."""
    for name, (low, high) in bounds.items():
        check_number(name, getattr(values, name), low, high)
