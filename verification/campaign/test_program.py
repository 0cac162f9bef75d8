"""The command of every campaign, with trials that only write: side by side, gone on with, a rig that breaks."""

import argparse
import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from verification.campaign.bench import Bench
from verification.campaign.outcomes import TrialOutcome
from verification.campaign.program import Campaign, main

pytestmark = pytest.mark.waiting


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(TrialOutcome):
    number: int
    rig: str


class CountingBench(Bench[int, Outcome]):
    """A rig is a folder; a trial of 3 is red, one of 5 breaks its rig once, one of 7 always."""

    def __init__(self, folder: Path, *, log: Path) -> None:
        super().__init__(folder)
        self._log = log

    def do(self, trial: int) -> Outcome:
        rig = self.rig(_noted, is_good=True)
        with self._log.open("a") as log:
            log.write(f"{trial}\n")
        if trial == 7 or (trial == 5 and self._log.read_text().count("5\n") == 1):
            raise RuntimeError("broke")
        return Outcome(number=trial, rig=rig.name, troubles=("red",) if trial == 3 else ())

    def broken(self, trial: int, *, is_last: bool) -> Outcome | None:
        return Outcome(number=trial, rig="", troubles=("no result",)) if is_last else None


@contextlib.contextmanager
def _noted(folder: Path) -> Iterator[Path]:
    folder.mkdir(parents=True)
    yield folder
    (folder / "closed").touch()


class Counting(Campaign[int, Outcome]):
    name = "counting"
    kind = Outcome

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--numbers", type=lambda text: [int(one) for one in text.split(",")])

    def trials(self, asked: argparse.Namespace) -> list[int]:
        if 0 in asked.numbers:
            raise ValueError("0 is none")
        return asked.numbers

    def key_of(self, outcome: Outcome) -> int:
        return outcome.number

    @contextlib.contextmanager
    def benches(self, asked: argparse.Namespace, folder: Path) -> Iterator[Callable[[Path], CountingBench]]:
        yield partial(CountingBench, log=asked.out / "log")

    def label(self, outcome: Outcome) -> str:
        return str(outcome.number)

    def report(self, console, outcomes: Sequence[Outcome], asked: argparse.Namespace) -> int:
        (asked.out / "report").write_text(" ".join(str(one.number) for one in sorted(outcomes, key=self.key_of)))
        return int(any(one.is_red for one in outcomes) or len(outcomes) < len(asked.numbers))


class EndingCounting(Counting):
    is_over_at_red = True


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr("verification.campaign.program.revision_of_the_code", lambda: "r1")
    monkeypatch.setattr("signal.signal", lambda *_: None)
    words = ["--out", str(tmp_path)]
    return lambda numbers, *more, of=Counting, jobs=1: main(
        of(), None, [*words, "--numbers", numbers, "--jobs", str(jobs), *more]
    )


def kept(folder: Path) -> dict[int, Outcome]:
    return {one.number: one for one in Counting().kept_in(folder).read()}


def test_trials_are_done_side_by_side_and_kept_with_the_state_of_the_code(run, tmp_path):
    assert run("1,2,4,6", jobs=2) == 0
    assert (tmp_path / "report").read_text() == "1 2 4 6"
    assert {one.revision for one in kept(tmp_path).values()} == {"r1"}


def test_what_is_done_is_not_done_again_and_other_trials_are_not_reported(run, tmp_path):
    assert run("1,2") == 0
    assert run("2,4") == 0
    assert (tmp_path / "log").read_text().split() == ["1", "2", "4"]
    assert (tmp_path / "report").read_text() == "2 4"


def test_a_rig_is_kept_until_a_trial_is_red_or_breaks_it(run, tmp_path):
    assert run("1,2,3,4,5,6") == 1
    found = kept(tmp_path)
    assert [found[number].rig for number in (1, 2, 3, 4, 5, 6)] == ["1", "1", "1", "2", "3", "3"]
    assert "broke" in found[5].note
    assert found[5].troubles == ()


def test_a_trial_that_breaks_every_rig_has_no_result(run, tmp_path):
    assert run("7,1") == 1
    found = kept(tmp_path)
    assert found[7].troubles == ("no result",)
    assert found[7].note.count("RuntimeError: broke") == 2
    assert not found[1].is_red


def test_the_first_red_one_ends_a_campaign_that_is_over_then(run, tmp_path):
    assert run("3,1,2,4,6,8", of=EndingCounting) == 1
    assert (tmp_path / "report").read_text() == "3"
    assert run("3,1,2", "--go-on", of=EndingCounting) == 1
    assert (tmp_path / "report").read_text() == "1 2 3"


def test_another_state_of_the_code_and_what_does_not_exist_are_refused_and_nothing_is_done(run, tmp_path, monkeypatch):
    assert run("1") == 0
    monkeypatch.setattr("verification.campaign.program.revision_of_the_code", lambda: "r2")
    assert run("2") == 2
    assert run("0") == 2
    assert (tmp_path / "log").read_text() == "1\n"
    assert run("2", "--keep") == 0


def test_a_campaign_that_mounts_a_disk_is_refused_without_root(run, monkeypatch):
    monkeypatch.setattr(Counting, "needs_root", True)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert run("1") == 2
