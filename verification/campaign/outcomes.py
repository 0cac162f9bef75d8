"""A campaign's memory: one line of JSON a trial, appended as it comes; a campaign goes on where it was stopped."""

import contextlib
import json
from collections.abc import Callable, Hashable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, Self, TypeVar


class OtherRevisionError(Exception):
    """The folder holds outcomes of another state of the code."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialOutcome:
    """What every campaign keeps of a trial."""

    troubles: tuple[str, ...] = ()
    note: str = ""
    revision: str = ""
    seconds: float = 0.0

    @property
    def is_red(self) -> bool:
        """Whether anything at all was not as promised."""
        return bool(self.troubles)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        return cls(
            **{name: tuple(value) if isinstance(value, list) else value for name, value in dict(document).items()}
        )


Kept = TypeVar("Kept", bound=TrialOutcome)


class OutcomeFile(Generic[Kept]):
    """Outcomes in a file; a line that a kill cut short is dropped, and its trial done again.

    Parameters
    ----------
    key_of
        What names a trial: of several outcomes of one the newest counts.
    """

    def __init__(self, path: Path, kind: type[Kept], key_of: Callable[[Kept], Hashable]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._kind = kind
        self._key_of = key_of

    def read(self) -> list[Kept]:
        """Return what is there, the newest of each trial."""
        found: dict[Hashable, Kept] = {}
        for line in self.path.read_text().splitlines() if self.path.exists() else ():
            with contextlib.suppress(ValueError, KeyError, TypeError):
                outcome = self._kind.from_json(json.loads(line))
                found[self._key_of(outcome)] = outcome
        return list(found.values())

    def append(self, outcome: Kept) -> None:
        """Add one; behind a cut line a new one is begun."""
        line = json.dumps(outcome.to_json(), separators=(",", ":")) + "\n"
        with self.path.open("a+b") as file:
            if file.tell() > 0:
                file.seek(-1, 2)
                line = line if file.read(1) == b"\n" else "\n" + line
            file.write(line.encode())


def refuse_other_revision(outcomes: Iterable[TrialOutcome], revision: str) -> None:
    """Raise OtherRevisionError unless all outcomes are of this state of the code."""
    others = sorted({outcome.revision for outcome in outcomes} - {revision})
    if others:
        msg = f"the folder holds outcomes of {', '.join(others)}, and this is {revision}: take another, or --keep"
        raise OtherRevisionError(msg)
