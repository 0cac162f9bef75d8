"""The campaign's short form: two thirds of the kinds, other ones at each commit, each once."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.faults.campaign import Bench
from tests.faults.kinds import all_kinds
from tests.faults.template import learned

ROOT = Path(__file__).parents[2]
PARTS = 3


def _left_out() -> int:
    """Which part of the kinds is left out: the commit says, so that it is the same for everybody who has it."""
    command = ["git", "rev-parse", "--short=4", "HEAD"]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
    return int(told, 16) % PARTS if told else 0


LEFT_OUT = _left_out()
KINDS = sorted(
    (kind for place, kind in enumerate(all_kinds()) if place % PARTS != LEFT_OUT), key=lambda kind: kind.plan.name
)
"""Kinds that need the same service side by side: it is started once for them."""

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="a small file system is mounted, which takes root"),
    pytest.mark.timeout(600),
]


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
