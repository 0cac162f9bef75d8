"""Twenty sessions on one recording, started at twenty moments of the breath: each reference is at the end of exhale."""

import pytest

from tests.support.evaluation.confirmed_references import STARTS, STEP_S, confirmed_references

pytestmark = [pytest.mark.long, pytest.mark.verification]


@pytest.mark.timeout(900)
def test_the_references_of_twenty_starts_lie_within_five_per_cent_of_the_end_of_exhale(calm_volunteer):
    found = confirmed_references(calm_volunteer)
    assert len(found) == STARTS == 20
    assert found[-1].start_s - found[0].start_s > 0.9 * (STARTS - 1) * STEP_S
    assert all(one.breaths >= 2 for one in found)
    assert max(abs(one.error_percent) for one in found) <= 5.0
    # A proposal of the training's breaths: nothing has to be waited for behind the model.
    assert max(one.confirmed_s - one.model_s for one in found) < 1.0
