"""One worker's place in a campaign: one rig at a time, kept for as long as it is good for the next trial."""

import contextlib
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from verification.campaign.outcomes import TrialOutcome

ATTEMPTS = 2
"""A rig that broke in a way no one foresaw is replaced, and the trial done once more; the first's story is kept."""

Trial = TypeVar("Trial")
Kept = TypeVar("Kept", bound=TrialOutcome)


class Bench(ABC, Generic[Trial, Kept]):
    """Does trials; a red outcome and a rig that broke throw the rig away."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held = contextlib.ExitStack()
        self._rig: Any = None
        self._rigs = 0

    @abstractmethod
    def do(self, trial: Trial) -> Kept:
        """Do a trial, with the rig of :meth:`rig` if it needs one; may raise anything."""

    @abstractmethod
    def broken(self, trial: Trial, *, is_last: bool) -> Kept | None:
        """Return the outcome of a trial that raised; None where it is to be done again."""

    def try_one(self, trial: Trial) -> Kept:
        """Do a trial; where it raises, throw the rig away and do it again, once."""
        stories: list[str] = []
        while True:
            try:
                outcome = self.do(trial)
            except Exception:  # noqa: BLE001 - whatever broke, the next trial has to go on
                stories.append(traceback.format_exc(limit=-3))
                found = self.broken(trial, is_last=len(stories) == ATTEMPTS)
                self.clear()
                if found is not None:
                    return replace(found, note="\n".join(stories))
            else:
                if outcome.is_red:
                    self.clear()
                return replace(outcome, note="\n".join([*stories, outcome.note]).strip())

    def rig(self, make: Callable[[Path], contextlib.AbstractContextManager[Any]], *, is_good: bool) -> Any:
        """Return the rig; replace it, in another folder, unless it ``is_good`` for the next trial."""
        if self._rig is not None and not is_good:
            self.clear()
        if self._rig is None:
            self._rigs += 1
            self._rig = self._held.enter_context(make(self._folder / str(self._rigs)))
        return self._rig

    def clear(self) -> None:
        """Let go of everything that the rig started and mounted."""
        self._rig = None
        held, self._held = self._held, contextlib.ExitStack()
        held.close()

    def end(self) -> None:
        """Let go of everything."""
        self.clear()
