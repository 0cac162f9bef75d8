"""Settings of QA: bounds of every check, maximum age of the daily QA, and names on reports.

The fields of the bounds are generated from the engine's table of checks, two per check.
"""

from typing import TYPE_CHECKING, Any, Self

from pydantic import Field, create_model, field_validator, model_validator
from pydantic_settings import BaseSettings

from engine.qa import CHECKS, QaBound, QaBounds, QaCheck
from service.core.settings.names import setting_name

LONGEST_DAILY_H = 744.0
SHORTEST_LATENCY_DAYS, LONGEST_LATENCY_DAYS = 1.0, 1100.0
MAX_NAME = 80


def setting_of(code: str, bound: str) -> str:
    """Return the name of the setting of a check's ``warn`` or ``fail``."""
    return f"qa_{code}_{bound}"


def _bound(check: QaCheck, bound: str) -> tuple[type[float], Any]:
    words = f"{check.title}: {'warns' if bound == 'warn' else 'fails'} beyond" + (f" [{check.unit}]" * bool(check.unit))
    return (float, Field(default=getattr(check, bound), ge=0.0, le=check.most, description=words))


if TYPE_CHECKING:
    _CheckBounds = BaseSettings
else:
    _CheckBounds = create_model(
        "_CheckBounds",
        __base__=BaseSettings,
        **{
            setting_of(check.code, bound): _bound(check, bound)  # in the order of the table
            for check in CHECKS
            for bound in ("warn", "fail")
        },
    )


class QaSettings(_CheckBounds):
    """Settings of QA; a part of :class:`service.core.settings.settings.Settings`."""

    qa_required_daily_h: float = Field(
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
    site_name: str = Field(default="", max_length=MAX_NAME, description="On QA reports")
    machine_name: str = Field(default="", max_length=MAX_NAME, description="On QA reports: accelerator or room")

    @field_validator("site_name", "machine_name")
    @classmethod
    def _is_printable(cls, name: str) -> str:
        if not name.isprintable():
            msg = f"{name[:MAX_NAME]!r} must be printable characters"
            raise ValueError(msg)
        return name

    @model_validator(mode="after")
    def _warn_is_below_fail(self) -> Self:
        for check in CHECKS:
            warn, fail = self._bound_of(check)
            if warn > fail:
                name, other = (setting_name(setting_of(check.code, bound)) for bound in ("warn", "fail"))
                msg = f"{name} is {warn:g}: must be at most {other} ({fail:g})"
                raise ValueError(msg)
        return self

    @property
    def qa_bounds(self) -> QaBounds:
        """Bounds of every check."""
        bounds = {check.code: self._bound_of(check) for check in CHECKS}
        return QaBounds(chosen={code: QaBound(warn=warn, fail=fail) for code, (warn, fail) in bounds.items()})

    def _bound_of(self, check: QaCheck) -> tuple[float, float]:
        return getattr(self, setting_of(check.code, "warn")), getattr(self, setting_of(check.code, "fail"))
