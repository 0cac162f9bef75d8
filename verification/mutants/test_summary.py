"""The summary of `make mutants`: what mutmut noted is read as it is meant, and no one who survived is passed over."""

import json

import pytest

from tests.support.generated_sections import part_of
from verification.mutants import summary as mutants
from verification.mutants.summary import COLUMNS, main, outcome_of, outcomes, place_of, summary, survivors

CODES = {
    "engine.beam.wire.line_supervisor.xǁLineJudgeǁcheck__mutmut_1": 1,
    "engine.beam.wire.line_supervisor.xǁLineJudgeǁcheck__mutmut_2": 0,
    "engine.beam.wire.line_supervisor.x__silent__mutmut_3": 33,
    "engine.beam.wire.line_supervisor.x_silent__mutmut_4": 37,
    "engine.beam.wire.line_supervisor.x_silent__mutmut_5": -24,
    "engine.beam.wire.line_supervisor.x_silent__mutmut_6": None,
    "engine.beam.wire.line_supervisor.x_silent__mutmut_7": -11,
}


@pytest.fixture
def left_behind(tmp_path):
    folder = tmp_path / "mutants" / "engine" / "beam" / "wire"
    folder.mkdir(parents=True)
    (folder / "line_supervisor.py.meta").write_text(json.dumps({"exit_code_by_key": CODES}), encoding="utf-8")
    (folder / "line.py.meta").write_text(json.dumps({"exit_code_by_key": {}}), encoding="utf-8")
    return tmp_path / "mutants"


def test_each_mutant_is_counted_once_by_what_came_of_it(left_behind):
    found = outcomes(left_behind)
    assert list(found) == ["engine/beam/wire/line_supervisor.py"]
    assert summary(found).splitlines()[2:] == [
        "| `engine/beam/wire` | 7 | 1 | 1 | 1 | 1 | 2 | 1 |",
        "| **all** | 7 | 1 | 1 | 1 | 1 | 2 | 1 |",
    ]


def test_whatever_is_not_known_to_be_noticed_is_suspicious():
    assert {outcome_of(code) for code in range(-40, 300)} <= set(COLUMNS)
    assert outcome_of(77) == "suspicious"


def test_who_survived_or_is_suspicious_is_named_by_its_place(left_behind):
    assert [place_of(name) for name in survivors(outcomes(left_behind))] == [
        "engine.beam.wire.line_supervisor LineJudge.check 2",
        "engine.beam.wire.line_supervisor _silent 3",
        "engine.beam.wire.line_supervisor silent 7",
    ]


def test_the_table_is_written_and_only_an_explained_survivor_is_passed_over(left_behind, tmp_path, monkeypatch, capsys):
    page = tmp_path / "mutants.md"
    explained = "`engine.beam.wire.line_supervisor LineJudge.check 2`, `engine.beam.wire.line_supervisor _silent 3`"
    page.write_text("<!-- made: mutants -->\n<!-- end: mutants -->\n", encoding="utf-8")
    survivors_page = tmp_path / "survivors.md"
    survivors_page.write_text(explained, encoding="utf-8")
    monkeypatch.setattr(mutants, "PAGE", page)
    monkeypatch.setattr(mutants, "EXPLAINED", survivors_page)
    monkeypatch.setattr(mutants, "outcomes", lambda: outcomes(left_behind))
    assert main(["--write"]) == 1
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == "not explained in survivors.md: `engine.beam.wire.line_supervisor silent 7`"
    )
    assert part_of(page.read_text(encoding="utf-8"), "mutants") == summary(outcomes(left_behind))
    survivors_page.write_text(f"{explained}, `engine.beam.wire.line_supervisor silent 7`", encoding="utf-8")
    assert main([]) == 0


def test_nothing_left_behind_is_no_success(monkeypatch, capsys):
    monkeypatch.setattr(mutants, "outcomes", dict)
    assert main([]) == 1
    assert "make mutants" in capsys.readouterr().err
