"""Targets under atheris, one after the other, each in a child of a process that has instrumented our packages once.

``python -m verification.fuzz.drive WORK SECONDS INPUTS SEED TARGET...``; what each child says lies in
``WORK/TARGET.log``. Only our
own packages are instrumented, and before anything of them is imported. A seed of 0 is another one each time, and
``INPUTS`` of 0 as many as there is time for.
"""

import logging
import os
import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["engine", "service", "lab"]):
    from verification.fuzz.targets import TARGETS

from verification.fuzz.options import options_of
from verification.fuzz.target import Target, folder_of_inputs


def main() -> int:
    """Run each for its time; 1 where something came out of any that is no refusal."""
    logging.disable()
    work, seconds, inputs, seed, *names = sys.argv[1:]
    with folder_of_inputs():
        ended = [_in_a_child(TARGETS[name], Path(work), int(seconds), int(inputs), int(seed)) for name in names]
    return max(ended)


def _in_a_child(target: Target, work: Path, seconds: int, inputs: int, seed: int) -> int:
    child = os.fork()
    if child == 0:
        with (work / f"{target.name}.log").open("wb") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        _fuzz(target, options_of(target, work=work, seconds=seconds, inputs=inputs, seed=seed))
    return min(1, os.waitpid(child, 0)[1])


def _fuzz(target: Target, options: list[str]) -> None:
    """Run until libFuzzer's options say that it is enough; the process ends with it."""

    @atheris.instrument_func
    def try_one(content: bytes) -> None:
        target.try_one(content)

    atheris.Setup([sys.argv[0], *options], try_one)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
