"""One target under atheris, in a process of its own: ``python -m tests.fuzz.drive TARGET [libFuzzer's options]``.

Only our own packages are instrumented, and before anything of them is imported.
"""

import logging
import sys

import atheris

with atheris.instrument_imports(include=["engine", "service"]):
    from tests.fuzz.targets import TARGETS


def main() -> None:
    """Run until libFuzzer's options say that it is enough, or something came out that is no refusal."""
    logging.disable()
    target = TARGETS[sys.argv[1]]

    @atheris.instrument_func
    def try_one(content: bytes) -> None:
        target.try_one(content)

    atheris.Setup([sys.argv[0], *sys.argv[2:]], try_one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
