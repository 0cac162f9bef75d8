"""Breaks each mechanism of the table once, in a copy of the sources, and runs the test that safety.md names for it.

Run: ``make planted``. A test that passes with its mechanism broken proves nothing: it is listed, and the command ends
with 1.
"""

import sys

from verification.campaign.program import main
from verification.planted.campaign import PlantedCampaign

if __name__ == "__main__":
    sys.exit(main(PlantedCampaign(), __doc__))
