"""A minute of fuzzing in all, from the same seed each time; what it finds it says how to see again."""

import pytest

from tests.campaigns.fuzz.run import run
from tests.campaigns.fuzz.targets import TARGETS

SECONDS = 60
SEED = 20_261_122
SLOW_START_EXECUTIONS = 20


@pytest.mark.slow
def test_a_minute_of_fuzzing_finds_nothing(tmp_path):
    targets = list(TARGETS.values())
    runs = run(targets, seconds=SECONDS // len(targets), work=tmp_path, seed=SEED)
    found = [one.how_to_see_it_again for one in runs if one.finding is not None]
    assert not found, "\n\n".join(found)
    for one in runs:
        assert one.executions > SLOW_START_EXECUTIONS, one.said[-2000:]
        assert one.coverage > 10, one.said[-2000:]
