"""The walks of docs/1-start/architecture.md as pictures: ``python -m tests.documentation.walks --write``.

Each picture has one lane a package and one box a file, in the order of the walk; an arrow leads from each step to the
next one in another file. Without ``--write`` it prints how many files each walk has, and how often it returns to one.
"""

import re
import sys
from html import escape
from itertools import pairwise
from pathlib import Path

from tests.support.repository import ROOT

PAGE = ROOT / "docs" / "1-start" / "architecture.md"
FOLDER = PAGE.parent / "walks"
WALK = re.compile(r"<!-- walk: (.+?) -->\n(.*?)<!-- end -->", re.DOTALL)
STEP = re.compile(r"^(\d+)\. `([\w/]+\.py)` `(\w+)`: .+$")
LANE_PX, ROW_PX, BOX_PX, HEAD_PX = 190, 30, 174, 34


def walks() -> dict[str, str]:
    """The text of each walk by its name."""
    return dict(WALK.findall(PAGE.read_text(encoding="utf-8")))


def steps_of(walk: str) -> list[tuple[str, str]]:
    """The file and the function of each step."""
    return [(found[2], found[3]) for line in walk.splitlines() if (found := STEP.fullmatch(line))]


def stays(files: list[str]) -> list[str]:
    """The files in the order in which they are entered."""
    return [files[0], *(after for before, after in pairwise(files) if after != before)]


def picture(name: str, steps: list[tuple[str, str]]) -> str:
    """Draw a walk as SVG: lanes are packages, rows are steps."""
    lanes = list(dict.fromkeys("/".join(path.split("/")[:2]) for path, _ in steps))
    places = [(lanes.index("/".join(path.split("/")[:2])), row) for row, (path, _) in enumerate(steps)]
    width, height = LANE_PX * len(lanes) + 8, HEAD_PX + ROW_PX * len(steps) + 8
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f"<title>{escape(name)}</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#567"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for lane, package in enumerate(lanes):
        parts.append(
            f'<rect x="{lane * LANE_PX + 4}" y="4" width="{BOX_PX + 8}" height="{height - 8}" fill="#eef2f5"/>'
        )
        parts.append(f'<text x="{lane * LANE_PX + 12}" y="22" font-size="13" fill="#123">{escape(package)}</text>')
    for (lane, row), (after, below) in pairwise(places):
        x, y = lane * LANE_PX + 8 + BOX_PX / 2, HEAD_PX + row * ROW_PX + 24
        to_x = after * LANE_PX + 8 + BOX_PX / 2
        parts.append(
            f'<line x1="{x:g}" y1="{y}" x2="{to_x:g}" y2="{HEAD_PX + below * ROW_PX}" stroke="#567" '
            'marker-end="url(#tip)"/>'
        )
    for (lane, row), (path, function) in zip(places, steps, strict=True):
        x, y = lane * LANE_PX + 8, HEAD_PX + row * ROW_PX
        parts.append(f'<rect x="{x}" y="{y}" width="{BOX_PX}" height="24" rx="3" fill="#fff" stroke="#567"/>')
        label = f"{row + 1} {Path(path).stem}.{function}"
        size = 11 if len(label) <= 30 else 9
        parts.append(f'<text x="{x + 6}" y="{y + 16}" font-size="{size}" fill="#123">{escape(label)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def pictures() -> dict[Path, str]:
    """Every picture by its file."""
    return {FOLDER / f"{name.replace(' ', '-')}.svg": picture(name, steps_of(text)) for name, text in walks().items()}


def main(arguments: list[str]) -> None:
    """Print the walks' sizes, or write the pictures."""
    if "--write" in arguments:
        FOLDER.mkdir(exist_ok=True)
        for path, text in pictures().items():
            path.write_text(text, encoding="utf-8")
    for name, text in walks().items():
        entered = stays([path for path, _ in steps_of(text)])
        sys.stdout.write(f"{name}: {len(set(entered))} files, {len(entered) - len(set(entered))} returns\n")


if __name__ == "__main__":
    main(sys.argv[1:])
