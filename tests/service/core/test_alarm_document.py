"""docs/2-clinical/alarms.md holds the tables that the code makes."""

from tests.support.documents import alarms
from tests.support.generated_sections import are_as_made


def test_the_tables_are_those_of_the_code():
    assert are_as_made(alarms.DOCUMENT, alarms.MADE), "run `python -m tests.support.documents.alarms --write`"
