"""The kill campaign: ``python -m verification.kills --moments 200 --jobs 2 --seed 1 --out DIR``.

Exit code 0 when every kill left everything as promised; 1 at the first that did not; 2 for a usage that is none. A
campaign that was stopped goes on where it was, with the same folder and seed.
"""

import sys

from verification.campaign.program import main
from verification.kills.campaign import KillCampaign

if __name__ == "__main__":
    sys.exit(main(KillCampaign(), __doc__))
