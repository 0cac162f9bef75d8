"""The campaign's short form: one kill each at the places that are worst."""

import os

import pytest

from tests.campaigns.faults.template import learned_once
from tests.campaigns.kills.campaign import Bench
from tests.support.build_cache import run_folder

WORST = ("behind-edge", "stopping", "recovering", "session-starts")

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="a small file system is mounted, which takes root"),
    pytest.mark.timeout(600),
    pytest.mark.alone,
    pytest.mark.long,
]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kills")
    held = Bench(folder, learned_once(run_folder(tmp_path_factory) / "learned"))
    yield held
    held.clear()


@pytest.mark.parametrize(("number", "code"), list(enumerate(WORST)))
def test_a_kill_loses_no_transition_and_the_next_start_puts_everything_in_order(bench, number, code):
    outcome = bench.kill(number, 0, code)
    assert not outcome.is_red, f"{', '.join(outcome.troubles)}: {outcome.note}"
