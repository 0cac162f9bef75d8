"""A thousand inputs per target, from the same seed each time, at most a second; says how to see a finding again.

`make fuzz` runs longer; test_corpus.py runs every input that is kept.
"""

import pytest

from verification.fuzz.run import run
from verification.fuzz.targets import TARGETS

pytestmark = pytest.mark.long

SECONDS_PER_TARGET = 1
INPUTS_PER_TARGET = 1000
SEED = 20_261_122
SLOW_START_EXECUTIONS = 20


@pytest.mark.slow
def test_a_thousand_inputs_per_target_find_nothing(tmp_path):
    runs = run(list(TARGETS.values()), seconds=SECONDS_PER_TARGET, inputs=INPUTS_PER_TARGET, work=tmp_path, seed=SEED)
    found = [one.how_to_see_it_again for one in runs if one.finding is not None]
    assert not found, "\n\n".join(found)
    for one in runs:
        assert one.executions > SLOW_START_EXECUTIONS, one.said[-2000:]
        assert one.coverage > 10, one.said[-2000:]
