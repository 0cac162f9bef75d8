"""QA figures without a value: the checks of a stage that could not be measured."""

from engine.qa.checks import CHECKS
from engine.qa.results import QaFigure, QaNeed


def not_measured(need: QaNeed, reason: str) -> list[QaFigure]:
    """Return one figure with ``value=None`` and the reason as its detail for every check of that stage."""
    checks = (check for check in CHECKS if check.needs is need and not check.is_optional)
    return [QaFigure(code=check.code, value=None, detail=reason) for check in checks]
