"""The fault campaign: ``python -m verification.faults --seeds 40 --jobs 2 --out DIR``.

Exit code 0 when every trial was safe, reported and recovered; 1 when one was not, or is missing; 2 for a usage
that is none. A campaign that was stopped goes on where it was, with the same folder.
"""

import sys

from verification.campaign.program import main
from verification.faults.campaign import FaultCampaign

if __name__ == "__main__":
    sys.exit(main(FaultCampaign(), __doc__))
