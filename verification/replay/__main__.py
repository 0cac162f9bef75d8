"""Plays sessions of many volunteers with many troubles, replays each, and prints what came of it.

`python -m verification.replay --sessions 50` is the campaign of docs/3-operate/replay.md.
Exit code 1 where a replay differed.
"""

import sys

from verification.campaign.program import main
from verification.replay.campaign import ReplayCampaign

if __name__ == "__main__":
    sys.exit(main(ReplayCampaign(), __doc__))
