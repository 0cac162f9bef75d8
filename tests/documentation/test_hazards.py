"""docs/2-clinical/safety.md and hazards.md: every rule and hazard is rated and names tests that exist and ran."""

import pytest

from tests.support.documents.hazards import (
    HAZARDS,
    PROBABILITIES,
    SAFETY,
    SEVERITIES,
    check,
    named,
    named_in,
    not_run,
    sections,
)
from tests.support.repository import ROOT
from tests.support.selection import STAGES

RULES = sections(SAFETY.read_text(encoding="utf-8"))
ROWS = sections(HAZARDS.read_text(encoding="utf-8"))


def test_each_rule_names_tests_and_is_put_to_the_test_by_a_hazard():
    assert [rule.number for rule in RULES] == list("12345678")
    assert all(rule.tests for rule in RULES)
    assert {rule for hazard in ROWS for rule in hazard.rating[3]} == set("12345678")


def test_each_hazard_is_rated_and_no_mitigation_makes_it_more_probable():
    assert len({hazard.number for hazard in ROWS}) == len(ROWS) > 60
    for hazard in ROWS:
        severity, without, with_it, _ = hazard.rating
        assert severity in SEVERITIES
        assert PROBABILITIES.index(with_it) <= PROBABILITIES.index(without)


def test_only_hazards_without_a_mitigation_that_can_be_tested_name_no_test():
    assert [hazard.number for hazard in ROWS if not hazard.tests] == ["H3", "H4"]


def test_every_named_test_exists():
    sources = {path: (ROOT / path).read_text(encoding="utf-8") for path in {one.partition("::")[0] for one in named()}}
    assert named_in("lab") == [], "that stage is left out on a slow machine"
    assert [one for one in named() if f"def {one.partition('::')[2]}(" not in sources[one.partition("::")[0]]] == []


def test_a_named_test_that_did_not_run_is_found_among_cases_and_files():
    ran = ["tests/a/test_x.py::test_one[3]", "tests/b/test_y.py::test_two"]
    expected = ["tests/a/test_x.py::test_one", "tests/b/test_y.py", "tests/a/test_x.py::test_on", "tests/c/test_z.py"]
    assert not_run(expected, ran) == expected[2:]


@pytest.mark.parametrize("stage", STAGES[:2])
def test_the_check_of_a_run_names_what_did_not_run(tmp_path, capsys, stage):
    first, *others = named_in(stage)
    ran = tmp_path / "part.xml"

    def write(tests, inside=""):
        cases = [test.partition("::") for test in tests]
        ran.write_text(
            "<testsuites><testsuite>"
            + "".join(
                f'<testcase classname="{path[:-3].replace("/", ".")}" name="{name}">{inside}</testcase>'
                for path, _, name in cases
            )
            + "</testsuite></testsuites>"
        )

    write(others)
    assert check(stage, [ran, tmp_path / "absent.xml"]) == 1
    assert capsys.readouterr().out == f"safety.md or hazards.md names {first}, which did not run\n"
    write([first, *others])
    assert check(stage, [ran]) == 0
    write([first, *others], "<skipped/>")
    assert check(stage, [ran]) == 1
