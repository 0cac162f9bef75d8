"""The catalogue of problems is the code's, says of each code when it comes and what helps, and lies in the docs."""

from service.web.problems.catalogue import CATALOGUE, WHAT_TO_DO
from service.web.problems.table import STATUS_OF, code_of
from tests.support.documents.problems import PAGE, page


def test_the_page_is_made_from_the_code():
    stale = "python -m tests.support.documents.problems --write"
    assert PAGE.read_text(encoding="utf-8") == page(), stale


def test_every_code_states_when_it_comes_and_what_to_do(subtests):
    for entry in CATALOGUE.values():
        with subtests.test(entry.code):
            assert entry.title
            assert entry.when.endswith(".")
            assert entry.what_to_do.endswith(".")
            assert 400 <= entry.status <= 599


def test_every_error_of_the_table_is_in_the_catalogue_and_nothing_else_is_explained():
    assert {code_of(kind) for kind in STATUS_OF} <= CATALOGUE.keys()
    assert WHAT_TO_DO.keys() == CATALOGUE.keys()
