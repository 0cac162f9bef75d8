"""Authorisation table: (method, path template) -> required permission. A route that is not listed is refused.

WebSockets are listed under the method "WEBSOCKET". The page's static files are not routes: they hold no data, and the
guard serves them without a log-in.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

from service.core.permissions import Permission

SOCKET = "WEBSOCKET"
V1 = "/api/v1"
SESSION = f"{V1}/sessions/{{session_id}}"
PEOPLE_ONLY = frozenset({("POST", f"{SESSION}/presence")})
"""Calls refused to keys whatever their scopes: presence is a person's (ADR 0024)."""
BEFORE_THE_PASSWORD_IS_CHANGED = frozenset(
    {("GET", f"{V1}/me"), ("POST", f"{V1}/me/password"), ("POST", f"{V1}/logout")}
)
"""The only calls allowed while a one-time password has not been changed."""


class Open(Enum):
    """Routes that require no permission: public, or any authenticated identity."""

    PUBLIC = "public"
    ANYONE_LOGGED_IN = "anyone logged in"


Needs: TypeAlias = Permission | Open

RULES: Mapping[tuple[str, str], Needs] = {
    ("GET", "/healthz"): Open.PUBLIC,
    ("GET", "/readyz"): Open.ANYONE_LOGGED_IN,
    ("GET", "/metrics"): Permission.METRICS_READ,
    # The contract is published with the source; who writes a client reads it without an account.
    ("GET", f"{V1}/openapi.json"): Open.PUBLIC,
    ("HEAD", f"{V1}/openapi.json"): Open.PUBLIC,
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
    ("GET", f"{SESSION}/report"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/trace"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/moment"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/report.pdf"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/report.html"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/waveform.dcm"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/report.dcm"): Permission.SESSIONS_READ,
    ("POST", f"{SESSION}/send"): Permission.GATE_REFERENCE,
    ("POST", f"{SESSION}/simulation"): Permission.GATE_REFERENCE,
    ("GET", f"{SESSION}/simulation"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/pacs"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/picture"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/mesh"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/transitions"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/models"): Permission.SESSIONS_READ,
    ("GET", f"{SESSION}/arming"): Permission.SESSIONS_READ,
    ("POST", f"{SESSION}/start"): Permission.SESSIONS_RUN,
    ("POST", f"{SESSION}/reference"): Permission.GATE_REFERENCE,
    ("POST", f"{SESSION}/position-check"): Permission.GATE_REFERENCE,
    ("POST", f"{SESSION}/countersign"): Permission.GATE_REFERENCE,
    ("POST", f"{SESSION}/note"): Permission.GATE_REFERENCE,
    ("POST", f"{SESSION}/signature"): Permission.GATE_REFERENCE,
    ("POST", f"{SESSION}/presence"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/arm"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/release"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/baseline-correction"): Permission.GATE_ARM,
    ("POST", f"{SESSION}/window"): Permission.SESSIONS_RUN,
    ("POST", f"{SESSION}/hold"): Permission.GATE_HOLD,
    ("POST", f"{SESSION}/disarm"): Permission.GATE_HOLD,
    ("POST", f"{SESSION}/stop"): Permission.GATE_HOLD,
    ("POST", f"{SESSION}/acknowledge"): Permission.GATE_ACKNOWLEDGE,
    ("POST", f"{SESSION}/models/retrain"): Permission.MODELS_WRITE,
    ("POST", f"{SESSION}/models/apply"): Permission.MODELS_WRITE,
    ("POST", f"{V1}/models/{{model_id}}/activate"): Permission.MODELS_WRITE,
    ("GET", f"{V1}/models/{{model_id}}"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/models/{{model_id}}/spectrum"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/models/{{model_id}}/quality-maps"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/models/{{model_id}}/similarity"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/devices"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/recordings"): Permission.SESSIONS_READ,
    ("GET", f"{V1}/interlocks"): Permission.SESSIONS_READ,
    # Patient screens
    ("POST", f"{V1}/coach/code"): Permission.COACH_MANAGE,
    ("POST", f"{V1}/coach/pair"): Open.PUBLIC,
    ("GET", f"{V1}/coach/screens"): Permission.COACH_MANAGE,
    ("POST", f"{V1}/coach/screens/{{screen_id}}/end"): Permission.COACH_MANAGE,
    ("GET", f"{V1}/coach/me"): Permission.COACH_WATCH,
    (SOCKET, f"{V1}/coach/live"): Permission.COACH_WATCH,
    ("GET", f"{SESSION}/coaching"): Permission.SESSIONS_READ,
    ("PUT", f"{SESSION}/coaching"): Permission.COACH_MANAGE,
    # Treatment plans
    ("GET", f"{V1}/plans"): Permission.SESSIONS_READ,
    ("POST", f"{V1}/plans"): Permission.PLANS_WRITE,
    ("GET", f"{V1}/plans/{{plan_id}}"): Permission.SESSIONS_READ,
    ("POST", f"{V1}/plans/{{plan_id}}/sessions"): Permission.SESSIONS_RUN,
    # Calibrations and QA
    ("GET", f"{V1}/calibrations"): Permission.CALIBRATIONS_READ,
    ("POST", f"{V1}/calibrations"): Permission.CALIBRATIONS_WRITE,
    ("GET", f"{V1}/calibrations/{{calibration_id}}"): Permission.CALIBRATIONS_READ,
    ("POST", f"{V1}/qa/runs"): Permission.QA_RUN,
    ("GET", f"{V1}/qa/runs"): Permission.QA_READ,
    ("GET", f"{V1}/qa/runs/{{run_id}}"): Permission.QA_READ,
    ("POST", f"{V1}/qa/runs/{{run_id}}/cancel"): Permission.GATE_HOLD,
    ("GET", f"{V1}/qa/runs/{{run_id}}/report.pdf"): Permission.QA_READ,
    ("GET", f"{V1}/qa/trend"): Permission.QA_READ,
    ("GET", f"{V1}/qa/checks"): Permission.QA_READ,
    ("GET", f"{V1}/qa/status"): Permission.QA_READ,
    ("GET", f"{V1}/qa/latency"): Permission.QA_READ,
    ("GET", f"{V1}/qa/baseline"): Permission.QA_READ,
    ("PUT", f"{V1}/qa/baseline"): Permission.QA_BASELINE,
    # Audit, and the settings that it records at each start
    ("GET", f"{V1}/machine"): Permission.AUDIT_READ,
    ("GET", f"{V1}/audit"): Permission.AUDIT_READ,
    ("GET", f"{V1}/audit/verify"): Permission.AUDIT_READ,
    ("GET", f"{V1}/audit/export"): Permission.AUDIT_READ,
}

TAKES_PERMISSION_AWAY = frozenset(call for call, needs in RULES.items() if needs is Permission.GATE_HOLD)
"""Calls that hold, disarm, stop or cancel: if authorised, never refused because of headers, parameters or body."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """The entry of the table that matches a request."""

    method: str
    template: str
    needs: Needs


class RuleTable:
    """Matches requests to rules as the router matches paths: literal paths before templates."""

    def __init__(self, rules: Mapping[tuple[str, str], Needs] = RULES) -> None:
        self._rules = rules
        templates = dict.fromkeys(template for _, template in rules)
        self._patterns = [(_pattern(template), template) for template in templates if "{" in template]
        self._literal = {template for template in templates if "{" not in template}

    def find(self, method: str, path: str) -> Rule | None:
        """Return the matching rule; None if there is none, and the call is refused."""
        for template in self.templates(path):
            needs = self._rules.get((method, template))
            if needs is not None:
                return Rule(method=method, template=template, needs=needs)
        return None

    def methods(self, path: str) -> list[str]:
        """Return the HTTP methods of a path, sorted; empty for an unknown path."""
        templates = self.templates(path)
        return sorted({method for method, template in self._rules if template in templates and method != SOCKET})

    def templates(self, path: str) -> list[str]:
        """Return the templates that match a path, the literal one first."""
        literal = [path] if path in self._literal else []
        return literal + [template for pattern, template in self._patterns if pattern.fullmatch(path)]


def _pattern(template: str) -> re.Pattern[str]:
    parts = re.split(r"(\{\w+\})", template)
    return re.compile("".join("[^/]+" if part.startswith("{") else re.escape(part) for part in parts))
