"""docs/2-clinical/traceability.md has every rule and hazard of safety.md, rated, with tests that ran."""

from tests.support.documents import traceability
from tests.support.documents.traceability import DOCUMENT, MADE, RATINGS, SAFETY, check, not_run, traced
from tests.support.generated_sections import are_as_made

ROWS = traced(SAFETY.read_text(encoding="utf-8"))


def test_the_document_is_as_made():
    assert are_as_made(DOCUMENT, MADE), "run `python -m tests.support.documents.traceability --write`"


def test_every_hazard_is_rated_once_and_every_rule_is_tested_by_hazards():
    assert [row.number for row in ROWS if not row.number.isdigit()] == list(RATINGS)
    rules = [row.number for row in ROWS if row.number.isdigit()]
    assert rules == list("12345678")
    assert {rule for rating in RATINGS.values() for rule in rating.rules.split()} == set(rules)
    assert all(row.tests for row in ROWS if row.number.isdigit())


def test_no_mitigation_makes_a_hazard_more_probable():
    for rating in RATINGS.values():
        assert rating.severity in traceability.SEVERITIES
        assert 1 <= rating.with_it <= rating.without <= 5


def test_only_hazards_whose_residual_risk_says_so_have_no_test():
    assert [row.number for row in ROWS if not row.tests] == ["H3", "H4"]


def test_a_named_test_that_did_not_run_is_found_among_cases_and_files():
    ran = ["tests/a/test_x.py::test_one[3]", "tests/b/test_y.py::test_two"]
    named = ["tests/a/test_x.py::test_one", "tests/b/test_y.py", "tests/a/test_x.py::test_on", "tests/c/test_z.py"]
    assert not_run(named, ran) == named[2:]


def test_the_check_of_a_run_names_what_did_not_run(tmp_path, capsys):
    every = dict.fromkeys(test for row in ROWS for test in row.tests)
    first = next(iter(every))
    ran = tmp_path / "part.xml"

    def write(tests, inside=""):
        cases = [test.partition("::") for test in tests]
        ran.write_text(
            "<testsuites><testsuite>"
            + "".join(
                f'<testcase classname="{path[:-3].replace("/", ".")}" name="{name or "test_it"}">{inside}</testcase>'
                for path, _, name in cases
            )
            + "</testsuite></testsuites>"
        )

    write(test for test in every if test != first)
    assert check([ran, tmp_path / "absent.xml"]) == 1
    assert capsys.readouterr().out == f"safety.md names {first}, which did not run\n"
    write(every)
    assert check([ran]) == 0
    write(every, "<skipped/>")
    assert check([ran]) == 1
