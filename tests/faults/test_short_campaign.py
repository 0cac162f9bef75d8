"""The campaign's short form: every kind of fault once, in the real process, over the real line."""

import os

import pytest

from tests.faults.campaign import Bench
from tests.faults.kinds import all_kinds
from tests.faults.template import learned

KINDS = sorted(all_kinds(), key=lambda kind: kind.plan.name)
"""Kinds that need the same service side by side: it is started once for them."""

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="a small file system is mounted, which takes root")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    held = Bench(folder, learned(folder / "template"))
    yield held
    held.clear()


@pytest.mark.parametrize("kind", KINDS, ids=[kind.code for kind in KINDS])
def test_the_line_is_off_in_time_the_audit_says_why_and_the_beam_comes_back_as_promised(bench, kind):
    outcome = bench.try_kind(kind, seed=0)
    assert not outcome.is_red, f"{', '.join(outcome.troubles)} after {outcome.off_ms} ms: {outcome.note}"
