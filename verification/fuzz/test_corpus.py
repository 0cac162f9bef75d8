"""Every input that was ever worth keeping is read, or refused as documented, quickly and within little memory."""

import time
import tracemalloc

import pytest

from engine.core.errors import InvalidValueError
from tests.support.repository import ROOT
from verification.fuzz import record
from verification.fuzz.target import CORPUS, Target, check_refusal
from verification.fuzz.targets import TARGETS

MOST_BYTES = 1_000_000
LONGEST_S = 5.0
MOST_MEMORY = 80 * 1024 * 1024


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_every_kept_input_is_read_or_refused_and_one_at_least_is_read(target):
    begin_s = time.monotonic()
    was_read = [target.try_one(content) for content in target.kept().values()]
    assert any(was_read)
    assert target.refusals == () or not all(was_read) or len(was_read) < 5
    assert time.monotonic() - begin_s < LONGEST_S * max(1, len(was_read) / 10)


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_the_inputs_it_began_with_are_read(target):
    assert any(target.try_one(seed) for seed in target.seeds())


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_no_small_input_takes_much_memory(target, subtests):
    for name, content in target.kept().items():
        target.try_one(content)  # what is made once is not the input's
        tracemalloc.start()
        try:
            with subtests.test(name):
                target.try_one(content)
                assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY
        finally:
            tracemalloc.stop()


def test_the_corpus_is_small_and_has_an_archive_for_each_target_alone():
    assert sum(path.stat().st_size for path in CORPUS.iterdir()) < MOST_BYTES
    assert {path.name for path in CORPUS.iterdir()} == {f"{name}.zip" for name in TARGETS}


def test_what_is_kept_comes_back_and_the_same_gives_the_same_file(tmp_path, monkeypatch):
    monkeypatch.setattr("verification.fuzz.target.CORPUS", tmp_path)
    target, inputs = TARGETS["trace"], {"b": b"", "a": b"1,2"}
    assert target.kept() == {}
    target.keep(inputs)
    first = target.archive.read_bytes()
    assert list(target.kept().items()) == [("a", b"1,2"), ("b", b"")]
    target.keep(target.kept())
    assert target.archive.read_bytes() == first


def test_what_is_no_documented_refusal_comes_out_of_a_harness():
    def broken(_content: bytes) -> None:
        raise KeyError("inside")

    target = Target(name="x", reads="x", read=broken, refusals=(InvalidValueError,), seeds=lambda: ())
    with pytest.raises(KeyError):
        target.try_one(b"")


@pytest.mark.parametrize("words", ["", "a" * 3000])
def test_a_refusal_that_states_nothing_or_too_much_is_a_finding(words):
    with pytest.raises(AssertionError):
        check_refusal(ValueError(words))


def test_a_refusal_that_cannot_be_written_down_is_a_finding():
    with pytest.raises(UnicodeEncodeError):
        check_refusal(InvalidValueError("\ud800", 1, "x"))


def test_the_page_reports_what_recorded_runs_did_as_the_command_prints_it():
    page = (ROOT / "docs/3-operate/security.md").read_text(encoding="utf-8")
    assert record.table() in page, "python -m verification.fuzz --report"
