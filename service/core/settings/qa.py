"""Settings of QA: bounds of every check, and maximum age of the daily QA and of a latency measurement."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from engine.core.errors import InvalidValueError
from engine.qa import CHECKS, QaBound, QaBounds, QaCheck
from service.core.settings.names import Env, Section

CHOSEN = "qa_bounds_chosen"
"""The setting that holds the bounds of checks."""
LONGEST_DAILY_H = 744.0
SHORTEST_LATENCY_DAYS, LONGEST_LATENCY_DAYS = 1.0, 1100.0


def setting_of(code: str, bound: str) -> str:
    """Return the name of the setting of a check's ``warn`` or ``fail``: its key in the section."""
    return f"{code}_{bound}"


KNOWN_BOUNDS = {setting_of(check.code, bound) for check in CHECKS for bound in ("warn", "fail")}


class QaSettings(Section):
    """Settings of QA; a part of :class:`service.core.settings.settings.Settings`."""

    SECTION = "qa"
    KEY_PREFIX = "qa_"

    qa_bounds_chosen: dict[str, Annotated[float, Field(ge=0.0)]] = Field(
        default={},
        description="Bounds of checks that the site chooses: CODE_warn and CODE_fail, each a key of the section qa",
    )
    qa_required_daily_h: Env[float] = Field(
        default=0.0,
        ge=0.0,
        le=LONGEST_DAILY_H,
        description="Arming needs a daily QA that passed within this time; 0 is never",
    )
    qa_latency_max_age_days: float = Field(
        default=365.0,
        ge=SHORTEST_LATENCY_DAYS,
        le=LONGEST_LATENCY_DAYS,
        description="Clinical mode: longest time since the latency of the session's camera was measured",
    )

    @model_validator(mode="after")
    def _bounds_are_possible(self) -> Self:
        unknown = self.qa_bounds_chosen.keys() - KNOWN_BOUNDS
        if unknown:
            msg = f"qa.{min(unknown)} is not a setting of Tidegate; mistyped?"
            raise ValueError(msg)
        try:
            _ = self.qa_bounds
        except InvalidValueError as error:
            msg = f"qa.{error.field} is {error.value}: must be {error.bound}"
            raise ValueError(msg.replace(".warn", "_warn").replace(".fail", "_fail")) from error
        return self

    @property
    def qa_bounds(self) -> QaBounds:
        """Bounds of every check."""
        chosen = self.qa_bounds_chosen

        def of(check: QaCheck) -> QaBound:
            warn, fail = (chosen.get(setting_of(check.code, one), getattr(check, one)) for one in ("warn", "fail"))
            return QaBound(warn=warn, fail=fail)

        return QaBounds(chosen={check.code: of(check) for check in CHECKS})
