"""Both campaigns, short: what matters most, an eighth of the other faults by the commit, the worst kills; each once."""

import os
import subprocess

import pytest

from tests.support.build_cache import run_folder
from tests.support.repository import ROOT
from verification.faults.campaign import FaultBench, Trial
from verification.faults.kinds import all_kinds, chosen
from verification.faults.template import learned_once
from verification.kills.campaign import Kill, KillBench

ALWAYS = frozenset(
    {
        *("marker-covered", "both-stall", "color-stalls", "clock-back", "clock-stands", "unplugged"),
        *("sheet-thin", "body-settles", "camera-sinks", "part-blind", "native-read-hangs"),
        *("engine-killed", "engine-stopped", "service-held", "beat-dies", "hearer-dies", "loop-blocked"),
        *("malformed-index-back", "killed", "stopped", "engine-dies", "engine-hangs", "watchdog-dies", "line-dies"),
        *("line-watch-dies", "writer-hangs", "interpreter-held", "disk-full", "database-locked", "receiver-frozen"),
        *("receiver-refuses", "contact-sticks-off", "contact-sticks-on", "held-by-hand", "disarmed", "zero-set"),
    }
)
"""What each commit has to pass."""

PARTS = 8
COMMIT = subprocess.run(
    ["git", "rev-parse", "--short=4", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
)
PART = int(COMMIT.stdout.strip() or "0", 16) % PARTS
"""Which part of the others is taken: the commit says, so that it is the same for everybody who has it."""
OTHERS = [kind for kind in all_kinds() if kind.code not in ALWAYS]
KINDS = sorted(chosen([*ALWAYS, *(kind.code for kind in OTHERS[PART::PARTS])]), key=lambda kind: kind.plan.name)
"""Kinds that need the same service side by side: it is started once for them."""
WORST = ("behind-edge", "stopping", "recovering", "session-starts")

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="a small file system is mounted, which takes root"),
    pytest.mark.timeout(600),
    pytest.mark.alone,
    pytest.mark.long,
]


@pytest.fixture(scope="module")
def benches(tmp_path_factory):
    learned = learned_once(run_folder(tmp_path_factory) / "learned")
    held = [made(tmp_path_factory.mktemp("campaign"), template=learned) for made in (FaultBench, KillBench)]
    yield held
    for one in held:
        one.end()


@pytest.mark.parametrize("kind", KINDS, ids=[kind.code for kind in KINDS])
def test_the_line_is_off_in_time_the_audit_states_why_and_the_beam_comes_back_as_promised(benches, kind):
    outcome = benches[0].try_one(Trial(kind.code, 0))
    assert not outcome.is_red, f"{', '.join(outcome.troubles)} after {outcome.off_ms} ms: {outcome.note}"


@pytest.mark.parametrize(("number", "code"), list(enumerate(WORST)))
def test_a_kill_loses_no_transition_and_the_next_start_puts_everything_in_order(benches, number, code):
    outcome = benches[1].try_one(Kill(number, 0, code))
    assert not outcome.is_red, f"{', '.join(outcome.troubles)}: {outcome.note}"
