"""Range checks: what is taken, what is refused, and how the refusal reads."""

import math

import pytest

from engine.core.bounds import check_number, check_numbers, check_whole_number
from engine.core.errors import CalibrationError, InvalidValueError


@pytest.mark.parametrize("value", [0, 0.0, 0.5, 1, 1.0])
def test_a_number_within_its_bounds_is_returned_as_a_float(value):
    checked = check_number("share", value, 0.0, 1.0)
    assert checked == value
    assert type(checked) is float


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1e-9, 1.0000001, True, "0.5", None, 10**1000])
def test_what_is_no_number_or_out_of_bounds_is_refused(value):
    with pytest.raises(InvalidValueError) as refusal:
        check_number("share", value, 0.0, 1.0)
    assert (refusal.value.field, refusal.value.bound) == ("share", "a number from 0 to 1")


def test_a_note_ends_the_sentence():
    with pytest.raises(InvalidValueError, match=r"^pulse is 2: must be a number from 20 to 150 ms$"):
        check_number("pulse", 2, 20.0, 150.0, "ms")


@pytest.mark.parametrize("value", [1.0, 1.5, True, math.nan, "1", None, 0, 65])
def test_only_whole_numbers_within_their_bounds_are_taken(value):
    assert check_whole_number("workers", 64, 1, 64) == 64
    with pytest.raises(InvalidValueError, match=r"must be a whole number from 1 to 64$"):
        check_whole_number("workers", value, 1, 64)


def test_the_refusal_is_of_the_kind_the_reader_of_a_document_raises():
    with pytest.raises(CalibrationError):
        check_number("depth.fx", -1, 0.0, 1.0, error=CalibrationError)
    with pytest.raises(CalibrationError):
        check_whole_number("depth.width", -1, 0, 1, error=CalibrationError)


def test_every_attribute_with_a_bound_is_checked():
    class Times:
        answer_ms, settle_ms = 100.0, 200.0

    check_numbers(Times, {"answer_ms": (0.0, 150.0)})
    with pytest.raises(InvalidValueError, match=r"settle_ms is 200\.0: must be a number from 0 to 150"):
        check_numbers(Times, {"answer_ms": (0.0, 150.0), "settle_ms": (0.0, 150.0)})
