"""The one-time code of a QA run on a real line: short lived, used once, one person's, and guessed in vain."""

import os
import stat
from dataclasses import replace
from datetime import timedelta

import pytest

from engine.core.clock import NS_PER_S
from service.core.errors import QaCodeError
from service.qa.one_time_code import MAX_TRIES, VALID_S, OneTimeCodes
from service.storage.database.base import TimeAnchor

ME = "A. Physicist"


class TwoClocks:
    """Wall clock and monotonic clock, each as a test sets it."""

    def __init__(self) -> None:
        self.now = TimeAnchor.now()

    def __call__(self) -> TimeAnchor:
        return self.now

    def step(self, *, wall_s: float = 0.0, steady_s: float = 0.0) -> None:
        at = self.now.at + timedelta(seconds=wall_s)
        self.now = replace(self.now, at=at, at_ns=self.now.at_ns + int(steady_s * NS_PER_S))


@pytest.fixture
def clock() -> TwoClocks:
    return TwoClocks()


@pytest.fixture
def codes(tmp_path, clock) -> OneTimeCodes:
    return OneTimeCodes(tmp_path, now=clock)


def refused(codes: OneTimeCodes, text: str | None, operator: str = ME) -> QaCodeError:
    with pytest.raises(QaCodeError) as error:
        codes.redeem(text, operator)
    return error.value


def test_a_code_opens_once(codes):
    made = codes.make(ME)
    assert codes.redeem(made, ME) == codes.now().at
    assert refused(codes, made).field == "code"


@pytest.mark.parametrize("changed", [str.lower, lambda code: f" {code} ", lambda code: code.replace("-", "")])
def test_a_code_is_taken_as_people_type_it(codes, changed):
    codes.redeem(changed(codes.make(ME)), "a. physicist")


def test_codes_differ_and_only_a_hash_is_kept_for_the_owner_alone(codes, tmp_path):
    before = os.umask(0)
    try:
        first, second = codes.make(ME), codes.make(ME)
    finally:
        os.umask(before)
    assert first != second
    (kept,) = tmp_path.iterdir()
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    text = kept.read_text(encoding="utf-8")
    assert second not in text
    assert second.replace("-", "") not in text


def test_a_new_code_ends_the_one_before(codes):
    first, second = codes.make(ME), codes.make(ME)
    refused(codes, first)
    codes.redeem(second, ME)


@pytest.mark.parametrize("step", [{"wall_s": VALID_S + 1.0}, {"steady_s": VALID_S + 1.0}], ids=str)
def test_a_code_ends_by_either_clock(codes, clock, step):
    made = codes.make(ME)
    clock.step(**step)
    refused(codes, made)


@pytest.mark.parametrize("step", [{"wall_s": -1.0}, {"steady_s": -1.0}], ids=str)
def test_a_clock_that_goes_back_ends_a_code(codes, clock, step):
    made = codes.make(ME)
    clock.step(**step)
    refused(codes, made)


def test_just_before_its_end_a_code_opens(codes, clock):
    made = codes.make(ME)
    clock.step(wall_s=VALID_S - 1.0, steady_s=VALID_S - 1.0)
    codes.redeem(made, ME)


def test_a_code_is_of_one_person(codes):
    made = codes.make(ME)
    refused(codes, made, "B. Physicist")
    codes.redeem(made, ME)


def test_wrong_tries_end_a_code_also_for_a_service_that_was_started_anew(codes, clock, tmp_path):
    made = codes.make(ME)
    for _ in range(MAX_TRIES):
        refused(OneTimeCodes(tmp_path, now=clock), "2222-2222")
    refused(codes, made)
    assert list(tmp_path.iterdir()) == []


def test_one_try_less_leaves_it(codes):
    made = codes.make(ME)
    for _ in range(MAX_TRIES - 1):
        refused(codes, "2222-2222")
    codes.redeem(made, ME)


def test_without_a_code_the_try_costs_nothing(codes):
    made = codes.make(ME)
    for _ in range(MAX_TRIES):
        assert refused(codes, None).value == "'missing'"
    codes.redeem(made, ME)


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff", b"[" * 10_000, b'{"operator": "A. Physicist"}'], ids=len)
def test_a_file_that_is_none_opens_nothing(codes, tmp_path, content):
    made = codes.make(ME)
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(content)
    refused(codes, made)


def test_a_refusal_repeats_no_code(codes):
    codes.make(ME)
    error = refused(codes, "3333-3333")
    assert "3333" not in f"{error} {error.value} {error.bound}"


@pytest.mark.parametrize("name", ["remove", "whole_file"])
def test_a_code_of_which_no_use_can_be_noted_opens_nothing(codes, monkeypatch, name):
    made = codes.make(ME)

    def fail(*_arguments, **_options):
        raise PermissionError(13, "denied")

    monkeypatch.setattr(f"service.qa.one_time_code.{name}", fail)
    refused(codes, made)
