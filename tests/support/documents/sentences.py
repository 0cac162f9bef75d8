"""The sentences that the service can say, for the language files.

``python -m tests.support.documents.sentences --write`` adds new ones to each language, in English, to be translated.
Every call of ``say`` has a literal; the words of enumerations that sentences contain are listed here.
"""

import ast
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from engine.core.breath import BreathEventKind, GateSignal
from engine.core.position_check import SHIFTS, TURNS
from engine.core.reference import ReferenceMoment
from engine.core.signals import HeadDirection
from engine.gating.supervision.checks import Check
from engine.gating.windows.breath_hold import HoldKind
from service.core.schemas.sessions import SessionStatus
from service.web.app import DASHBOARD, language_names

ROOT = Path(__file__).parents[3]
PREFIX = "say: "
FIELD = re.compile(r"\{(\w+)[^{}]*\}")
WORDS = (
    *(*BreathEventKind, *GateSignal, *SHIFTS, *TURNS, *ReferenceMoment, *HeadDirection, *Check, *HoldKind),
    *(*get_args(SessionStatus), "markers", "clock"),
)


def templates() -> set[str]:
    """Return the templates of all sentences, and the words in them."""
    found = {one for folder in ("engine", "service") for file in (ROOT / folder).rglob("*.py") for one in _said(file)}
    return found | {str(one) for one in WORDS}


def _said(file: Path) -> Iterator[str]:
    text = file.read_text()
    if "from engine.core.sentences import" not in text:
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "say":
            literal = node.args[0]
            assert isinstance(literal, ast.Constant), f"{file}:{node.lineno}: no literal"
            template = FIELD.sub(r"{\1}", literal.value)
            if re.search(r"[^\W\d_]", FIELD.sub("", template)):
                yield template


def main() -> None:
    """Add sentences that are new to the language files, in English; remove those that are gone."""
    wanted = {PREFIX + one for one in templates()}
    for name in language_names(DASHBOARD):
        file = DASHBOARD / "lang" / f"{name}.json"
        words = json.loads(file.read_text())
        kept = {key: text for key, text in words.items() if key in wanted or not key.startswith(PREFIX)}
        kept |= {key: key.removeprefix(PREFIX) for key in wanted - set(words)}
        file.write_text(json.dumps(kept, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


if __name__ == "__main__" and sys.argv[1:] == ["--write"]:
    main()
