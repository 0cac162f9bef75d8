"""The roles of QA: what a router may ask, and what makes runs; tests put fakes there."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from engine.calibration import Calibration
from service.conditional import ANYTHING, Precondition
from service.idempotency import CallersKey
from service.list_filters import ALL_RUNS, QaRunFilter
from service.ports import Kept
from service.qa import schemas
from service.qa.jobs import QaJob


@dataclass(frozen=True, slots=True, kw_only=True)
class QaFiles:
    """Where a request's recordings and its trace are; None for a camera, and for what is not asked for."""

    plate: Path | None = None
    phantom: Path | None = None
    trace: Path | None = None


class QaRig(Protocol):
    """Makes runs: the one way from QA in the service to cameras, recordings and the beam line."""

    def job(self, request: schemas.QaRunRequest, files: QaFiles, calibration: Calibration | None) -> QaJob:
        """Put a run together, nothing of it open yet; raise a TidegateError naming what cannot be used."""


class QaDeskPort(Protocol):
    """Runs under way: begun and cancelled; one at a time, and never beside a session."""

    def start(self, request: schemas.QaRunRequest, key: CallersKey | None) -> Kept[schemas.QaRun]:
        """Begin a run on a thread of its own."""

    def is_under_way(self, run_id: str) -> bool:
        """Whether this run goes on now, from memory."""

    def cancel(self, run_id: str, operator: str) -> schemas.QaRun:
        """Hold the line, then end the run."""


class QaBookPort(Protocol):
    """What is kept of QA."""

    def page(self, cursor: str | None, limit: int, wanted: QaRunFilter = ALL_RUNS) -> schemas.QaRunPage:
        """List runs, newest first."""

    def detail(self, run_id: str) -> schemas.QaRunDetail:
        """Read one, as it stands now."""

    def report_pdf(self, run_id: str) -> bytes:
        """Print a run that has finished."""

    def trend(self, check: str, limit: int) -> schemas.QaTrend:
        """Tell a check over the newest runs."""

    def checks(self) -> schemas.QaCheckList:
        """List what is checked, with this site's bounds."""

    def status(self) -> schemas.QaStatus:
        """Tell the newest runs, and whether the site's QA lets anybody arm."""

    def baseline(self) -> schemas.QaBaselineHistory:
        """Tell the baseline that holds, and those before it."""

    def fix_baseline(self, request: schemas.QaBaselineRequest, wanted: Precondition = ANYTHING) -> schemas.QaBaseline:
        """Fix another, as a named person says or as a run measured."""
