"""The one table of who may call what: (method, path template) -> what it takes. What is not here is refused to all.

Sockets stand under the method "WEBSOCKET". A file of the page is no route: it holds no data, and `guard` lets it be
read by anybody.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

from service.access.permissions import Permission


class Open(Enum):
    """What needs no permission."""

    PUBLIC = "public"
    ANYONE_LOGGED_IN = "anyone logged in"


Needs: TypeAlias = Permission | Open
SOCKET = "WEBSOCKET"
V1 = "/api/v1"
SESSION = f"{V1}/sessions/{{session_id}}"

RULES: Mapping[tuple[str, str], Needs] = {
    ("GET", "/healthz"): Open.PUBLIC,
    ("GET", "/readyz"): Open.ANYONE_LOGGED_IN,
    ("GET", "/metrics"): Permission.METRICS_READ,
    ("GET", f"{V1}/openapi.json"): Open.ANYONE_LOGGED_IN,
    ("HEAD", f"{V1}/openapi.json"): Open.ANYONE_LOGGED_IN,
    (SOCKET, f"{V1}/live"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/live/events"): Permission.SESSIONS_READ,
    # Log-ins, people, keys
    ("POST", f"{V1}/login"): Open.PUBLIC,
    ("GET", f"{V1}/login/ways"): Open.PUBLIC,
    ("GET", f"{V1}/login/oidc"): Open.PUBLIC,
    ("GET", f"{V1}/login/oidc/return"): Open.PUBLIC,
    ("POST", f"{V1}/logout"): Open.ANYONE_LOGGED_IN,
    ("GET", f"{V1}/me"): Open.ANYONE_LOGGED_IN,
    ("POST", f"{V1}/me/password"): Open.ANYONE_LOGGED_IN,
    ("GET", f"{V1}/me/logins"): Open.ANYONE_LOGGED_IN,
    ("POST", f"{V1}/me/logins/{{login_id}}/end"): Open.ANYONE_LOGGED_IN,
    ("GET", f"{V1}/users"): Permission.USERS_MANAGE,
    ("POST", f"{V1}/users"): Permission.USERS_MANAGE,
    ("GET", f"{V1}/users/{{name}}"): Permission.USERS_MANAGE,
    ("PATCH", f"{V1}/users/{{name}}"): Permission.USERS_MANAGE,
    ("GET", f"{V1}/users/{{name}}/logins"): Permission.USERS_MANAGE,
    ("POST", f"{V1}/users/{{name}}/logins/{{login_id}}/end"): Permission.USERS_MANAGE,
    ("GET", f"{V1}/keys"): Permission.USERS_MANAGE,
    ("POST", f"{V1}/keys"): Permission.USERS_MANAGE,
    ("GET", f"{V1}/keys/{{key_id}}"): Permission.USERS_MANAGE,
    ("POST", f"{V1}/keys/{{key_id}}/revoke"): Permission.USERS_MANAGE,
    # Sessions and the gate
    ("GET", f"{V1}/sessions"): Permission.SESSIONS_READ,
    ("POST", f"{V1}/sessions"): Permission.SESSIONS_RUN,
    ("GET", SESSION): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/samples"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/picture"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/mesh"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/transitions"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/models"): Permission.SESSIONS_READ,
    ("POST", f"{SESSION}/start"): Permission.SESSIONS_RUN,
    ("POST", f"{SESSION}/reference"): Permission.SESSIONS_RUN,
    ("POST", f"{SESSION}/presence"): Permission.SESSIONS_RUN,
    ("POST", f"{SESSION}/arm"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/release"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/baseline-correction"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/hold"): Permission.GATE_HOLD,
    ("POST", f"{SESSION}/disarm"): Permission.GATE_HOLD,
    ("POST", f"{SESSION}/stop"): Permission.GATE_HOLD,
    ("POST", f"{SESSION}/acknowledge"): Permission.GATE_ACKNOWLEDGE,
    ("POST", f"{SESSION}/models/retrain"): Permission.MODELS_WRITE,
    ("POST", f"{SESSION}/models/apply"): Permission.MODELS_WRITE,
    ("POST", f"{V1}/models/{{model_id}}/activate"): Permission.MODELS_WRITE,
    ("GET", f"{V1}/models/{{model_id}}"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/models/{{model_id}}/spectrum"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/devices"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/interlocks"): Permission.SESSIONS_READ,
    # What is prescribed
    ("GET", f"{V1}/plans"): Permission.SESSIONS_READ,
    ("POST", f"{V1}/plans"): Permission.PLANS_WRITE,
    ("GET", f"{V1}/plans/{{plan_id}}"): Permission.SESSIONS_READ,
    ("POST", f"{V1}/plans/{{plan_id}}/sessions"): Permission.SESSIONS_RUN,
    # What is measured with, and how well
    ("GET", f"{V1}/calibrations"): Permission.CALIBRATIONS_READ,
    ("POST", f"{V1}/calibrations"): Permission.CALIBRATIONS_WRITE,
    ("GET", f"{V1}/calibrations/{{calibration_id}}"): Permission.CALIBRATIONS_READ,
    ("POST", f"{V1}/qa/runs"): Permission.QA_RUN,
    ("GET", f"{V1}/qa/runs"): Permission.QA_READ,
    ("GET", f"{V1}/qa/runs/{{run_id}}"): Permission.QA_READ,
    ("POST", f"{V1}/qa/runs/{{run_id}}/cancel"): Permission.QA_RUN,
    ("GET", f"{V1}/qa/runs/{{run_id}}/report.pdf"): Permission.QA_READ,
    ("GET", f"{V1}/qa/trend"): Permission.QA_READ,
    ("GET", f"{V1}/qa/checks"): Permission.QA_READ,
    ("GET", f"{V1}/qa/status"): Permission.QA_READ,
    ("GET", f"{V1}/qa/baseline"): Permission.QA_READ,
    ("PUT", f"{V1}/qa/baseline"): Permission.QA_BASELINE,
    # What happened
    ("GET", f"{V1}/audit"): Permission.AUDIT_READ,
    ("GET", f"{V1}/audit/verify"): Permission.AUDIT_READ,
    ("GET", f"{V1}/audit/export"): Permission.AUDIT_READ,
}

TAKES_PERMISSION_AWAY = frozenset(
    {call for call, needs in RULES.items() if needs is Permission.GATE_HOLD}
    | {("POST", f"{V1}/qa/runs/{{run_id}}/cancel")}
)
"""Never refused over a header, a parameter or what the body says: whoever may, is obeyed."""

BEFORE_THE_PASSWORD_IS_CHANGED = frozenset(
    {("GET", f"{V1}/me"), ("POST", f"{V1}/me/password"), ("POST", f"{V1}/logout")}
)
"""All that somebody may do who still has the password that somebody else made."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """A line of the table, as found for a request."""

    method: str
    template: str
    needs: Needs


class RuleTable:
    """Finds the rule of a request by its path, as the router reads it."""

    def __init__(self, rules: Mapping[tuple[str, str], Needs] = RULES) -> None:
        self._rules = rules
        templates = dict.fromkeys(template for _, template in rules)
        self._patterns = [(_pattern(template), template) for template in templates if "{" in template]
        self._literal = {template for template in templates if "{" not in template}

    def find(self, method: str, path: str) -> Rule | None:
        """Return the rule of this call; None refuses it."""
        for template in self.templates(path):
            needs = self._rules.get((method, template))
            if needs is not None:
                return Rule(method=method, template=template, needs=needs)
        return None

    def methods(self, path: str) -> list[str]:
        """Return by which methods this path may be called."""
        templates = self.templates(path)
        return sorted({method for method, template in self._rules if template in templates and method != SOCKET})

    def templates(self, path: str) -> list[str]:
        """Return the templates that a path fits, the literal one first."""
        literal = [path] if path in self._literal else []
        return literal + [template for pattern, template in self._patterns if pattern.fullmatch(path)]


def _pattern(template: str) -> re.Pattern[str]:
    parts = re.split(r"(\{\w+\})", template)
    return re.compile("".join("[^/]+" if part.startswith("{") else re.escape(part) for part in parts))
