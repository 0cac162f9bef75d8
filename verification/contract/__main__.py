"""``python -m verification.contract --cases N --seed S``: a long campaign against the contract, with its summary."""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.support.contract.populated_service import World
from verification.contract.campaign import Campaign


def main() -> int:
    """Run it; returns 1 where anything was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=5_000, help="about so many")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tidegate-contract-") as folder, World(Path(folder)).open() as world:
        campaign = Campaign(world, number=arguments.seed)
        share = max(1, arguments.cases // (8 * len(campaign.operations())))
        campaign.succeed(3)
        campaign.cover(share)
        campaign.fuzz(2 * share)
        campaign.walk(max(1, arguments.cases // 100), 20)
    text = campaign.summary.text()
    sys.stdout.write(f"{text}\nseed {arguments.seed}, {time.monotonic() - began_s:.0f} s\n")
    return 1 if campaign.summary.failures else 0


if __name__ == "__main__":
    sys.exit(main())
