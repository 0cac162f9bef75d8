"""Fifty whole runs of a healthy set-up, every frame through the pipeline.

Run: ``python -m tests.campaigns.measurements.qa_runs [RUNS] [FIRST]``.

It takes some quarter of a minute of a processor a run, which is why the tests do with fifty runs on measured motion.
"""

import sys
from collections import Counter

from engine.verification.qa.bounds import QaBounds
from engine.verification.qa.results import QaKind, QaVerdict
from engine.verification.qa.rig import VIRTUAL_BASELINE, virtual_inputs
from engine.verification.qa.run import run_qa


def main(runs: int, first: int) -> int:
    """Do them, print the worst of each check against its bound, and return how many did not pass."""
    worst: dict[str, tuple[float, float]] = {}
    verdicts: Counter[QaVerdict] = Counter()
    for seed in range(first, first + runs):
        report = run_qa(
            QaKind.ANNUAL, virtual_inputs(seed=seed, plate_s=20.0), bounds=QaBounds(), baseline=VIRTUAL_BASELINE
        )
        verdicts[report.verdict] += 1
        for result in report.results:
            size = float("inf") if result.deviation is None else abs(result.deviation)
            worst[result.code] = (max(size, worst.get(result.code, (0.0, 0.0))[0]), result.warn)
        bad = [result.code for result in report.results if result.verdict is not QaVerdict.PASS]
        sys.stdout.write(f"seed {seed}: {report.verdict} {' '.join(bad)}\n")
        sys.stdout.flush()
    for code, (size, warn) in worst.items():
        sys.stdout.write(f"{code:28s} worst {size:8.3f}, warns beyond {warn:g}\n")
    sys.stdout.write(f"{verdicts[QaVerdict.PASS]} of {runs} passed\n")
    return runs - verdicts[QaVerdict.PASS]


if __name__ == "__main__":
    arguments = [int(text) for text in sys.argv[1:]]
    sys.exit(main(arguments[0] if arguments else 50, arguments[1] if len(arguments) > 1 else 1))
