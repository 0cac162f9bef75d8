"""How long each module of tests took: ``python -m tests.support.durations FILE...`` of ``pytest --junitxml``.

Seconds of all processes, set-ups included, by part of the tests and by module, the longest first.
"""

import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

SHOWN = 50
AREAS = 3
"""Parts of a path that name an area: ``tests/engine/motion``."""


def cases(files: Iterable[Path]) -> Iterator[tuple[str, float]]:
    """Yield the module and the seconds of every case in the files that are there."""
    for file in files:
        if file.exists():
            for case in ElementTree.parse(file).iter("testcase"):
                yield case.get("classname", "").replace(".", "/"), float(case.get("time", "0"))


def longest(seconds: Mapping[str, float]) -> list[tuple[str, float]]:
    """Return what is counted, the longest first."""
    return sorted(seconds.items(), key=lambda one: -one[1])


def table(files: Iterable[Path]) -> str:
    """Return the seconds of each area and of the longest modules, as text."""
    modules: defaultdict[str, float] = defaultdict(float)
    areas: defaultdict[str, float] = defaultdict(float)
    counts: Counter[str] = Counter()
    for module, seconds in cases(files):
        modules[module] += seconds
        areas["/".join(module.split("/")[:AREAS])] += seconds
        counts[module] += 1
    total = sum(modules.values())
    lines = [f"{total:8.0f} s  {sum(counts.values())} tests in {len(modules)} modules"]
    lines += [f"{seconds:8.0f} s  {100 * seconds / total:4.1f} %  {area}" for area, seconds in longest(areas)]
    lines += [f"the longest {SHOWN} modules"]
    lines += [f"{seconds:8.1f} s  {counts[module]:5d}  {module}" for module, seconds in longest(modules)[:SHOWN]]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table(Path(word) for word in sys.argv[1:]))
