"""About 1900 calls made up from the contract, in every role: no failure inside, no answer that is not documented."""

import pytest

from tests.support.contract.populated_service import CALLERS, World
from verification.contract.campaign import SLOW, Campaign

pytestmark = [pytest.mark.timeout(1_800), pytest.mark.long]
LEAST_CASES = 1_800
GOES_ELSEWHERE = frozenset({"begin_oidc_login", "finish_oidc_login", "list_login_ways"})
"""No provider stands behind these here; tests/service/access/oidc has one."""
LEAST_GOOD = 3
ONCE = SLOW | {"sign_report"}
"""A person signs a report once."""
WHAT_IS_MET = frozenset(
    {"not_logged_in", "permission_missing", "invalid_value", "not_found", "method_not_allowed", "media_type"}
)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    with World(tmp_path_factory.mktemp("contract")).open() as world:
        campaign = Campaign(world, number=7)
        campaign.succeed(LEAST_GOOD)
        campaign.cover(10)
        campaign.fuzz(4)
        campaign.walk(12, 20)
        yield campaign


def test_no_call_fails_inside_or_is_answered_otherwise_than_the_contract_states(campaign):
    assert campaign.summary.failures == {}, campaign.summary.text()


def test_so_many_calls_were_tried_in_every_role(campaign):
    summary = campaign.summary
    assert sum(summary.cases.values()) >= LEAST_CASES, summary.text()
    assert min(summary.cases[kind] for kind in ("coverage", "fuzzing", "stateful")) >= 200, summary.text()
    assert all(summary.by_caller[caller] >= LEAST_CASES / 10 for caller in CALLERS), summary.text()
    assert summary.codes.keys() >= WHAT_IS_MET


def test_every_call_succeeded_at_times(campaign):
    told = {str(operation.definition.raw["operationId"]) for operation in campaign.operations()} - GOES_ELSEWHERE
    least = {name: 1 if name in ONCE else LEAST_GOOD for name in told}
    rare = {name: campaign.summary.good[name] for name in sorted(told) if campaign.summary.good[name] < least[name]}
    assert rare == {}, campaign.summary.text()
