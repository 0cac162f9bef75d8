"""Numbers that leave the service: what could not be measured is None, never NaN, infinity or a magic number."""

import math


def finite_or_none(value: float | None) -> float | None:
    """Return a measured value as a float; None where it is missing, NaN or infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def rounded_or_none(value: float | None, digits: int = 4) -> float | None:
    """Return a measured value, rounded to so many decimals; None where it is missing, NaN or infinite."""
    finite = finite_or_none(value)
    return None if finite is None else round(finite, digits)
