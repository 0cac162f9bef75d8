"""Figures that could not be measured."""

from engine.qa.checks import CHECKS
from engine.qa.results import QaFigure, QaNeed


def not_measured(need: QaNeed, why: str) -> list[QaFigure]:
    """Return a figure without value for every check that is measured with this."""
    return [QaFigure(code=check.code, value=None, detail=why) for check in CHECKS if check.needs is need]
