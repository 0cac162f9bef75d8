"""Calls made up from the contract, sent to the service in every role; each answer held against the contract.

Three kinds: what the bounds of each schema suggest (`coverage`), what hypothesis makes up within and without the schema
(`fuzzing`), and walks from what one call made to those that take it (`stateful`).
"""

import contextlib
from collections import Counter
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Flaky, Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.config import SchemathesisConfig
from schemathesis.core.failures import Failure, FailureGroup
from schemathesis.specs.openapi import checks as openapi_checks

from tests.support.contract.populated_service import ADMIN, KEY, NOBODY, VIEWER, World


@schemathesis.serializer("application/dicom")
def as_it_is(_context: Any, value: Any) -> Any:
    """Send bytes as they are, and anything else as its text."""
    return value if isinstance(value, bytes) else str(value).encode()


CHECKS = [
    openapi_checks.status_code_conformance,
    openapi_checks.content_type_conformance,
    openapi_checks.response_headers_conformance,
    openapi_checks.response_schema_conformance,
    openapi_checks.negative_data_rejection,
    openapi_checks.unsupported_method,
    openapi_checks.allow_header_conformance,
]
MODES = {True: GenerationMode.POSITIVE, False: GenerationMode.NEGATIVE}
MAY_BE_UNAVAILABLE = frozenset({503, 507})
PROBLEM = "application/problem+json"
STREAM = "stream_events"
"""Has a schema of its own for each event: tests/service/web/stream holds them against it."""
REPORT = "read_qa_report"
SLOW = frozenset({STREAM, REPORT})
"""A stream goes on until the caller leaves, and a report is drawn anew by each call: each takes its seconds."""
TURNS = (ADMIN, ADMIN, KEY, ADMIN, VIEWER, ADMIN, ADMIN, NOBODY)
"""Who calls next: mostly somebody who may, so that more than the guard is tried."""
LEAST_GOOD = 3


@dataclass(kw_only=True)
class Summary:
    """What was tried and how it went."""

    cases: Counter = field(default_factory=Counter)
    statuses: Counter = field(default_factory=Counter)
    good: Counter = field(default_factory=Counter)
    by_caller: Counter = field(default_factory=Counter)
    codes: Counter = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """Tell it to a person."""
        lines = [f"{sum(self.cases.values())} cases: " + ", ".join(f"{n} {kind}" for kind, n in self.cases.items())]
        lines.append("by status: " + ", ".join(f"{status}: {n}" for status, n in sorted(self.statuses.items())))
        lines.append("by caller: " + ", ".join(f"{caller}: {n}" for caller, n in sorted(self.by_caller.items())))
        lines.append("by code: " + ", ".join(f"{code}: {n}" for code, n in sorted(self.codes.items())))
        lines.append(f"failures: {len(self.failures)}")
        lines += [f"--- {name}\n{text}" for name, text in self.failures.items()]
        return "\n".join(lines)


class Campaign:
    """Tries a world's contract."""

    def __init__(self, world: World, *, number: int = 1) -> None:
        self._world = world
        self._seed = number
        self._turn = 0
        self._is_ours = False
        self.document = world.app.openapi()
        self.schema = schemathesis.openapi.from_dict(_without_security(self.document), config=_config(number))
        self.schema.app = world.app
        self.summary = Summary()

    def operations(self) -> list[Any]:
        """List the operations of the contract."""
        return [found.ok() for found in self.schema.get_all_operations()]

    def succeed(self, times: int) -> None:
        """Try each operation as somebody who may, with what is there: so that not only refusals are looked at."""
        for operation in self.operations():
            for _ in range(1 if _is_slow(operation) else times):
                case = next(self._coverage(operation, GenerationMode.POSITIVE))
                self._send("prepared", case, ADMIN, is_kept=False)

    def cover(self, most: int) -> None:
        """Try what the bounds of each schema suggest, up to so many of each operation and kind."""
        for operation in self.operations():
            for is_positive, mode in MODES.items():
                for case in islice(self._coverage(operation, mode), 1 if _is_slow(operation) else most):
                    self._try("coverage", case, is_positive=is_positive)

    def fuzz(self, examples: int) -> None:
        """Try what hypothesis makes up, so many of each operation and kind."""
        for operation in self.operations():
            for is_positive, mode in MODES.items():
                self._fuzz_one(operation, mode, 1 if _is_slow(operation) else examples, is_positive=is_positive)

    def walk(self, walks: int, steps: int) -> None:
        """Walk from what one call made to those that take it, as schemathesis infers it."""
        campaign = self

        class Walker(self.schema.exclude(operation_id=sorted(SLOW)).as_state_machine()):  # type: ignore[misc]
            def get_call_kwargs(self, case: Any) -> dict[str, Any]:
                self.caller = campaign._next_caller()
                name = campaign._prepare(case, is_kept=input_has_link(case))
                return {"session": campaign._world.client, "headers": campaign._world.headers(self.caller, name)}

            def validate_response(self, response: Any, case: Any, **_options: Any) -> None:
                campaign._judge("stateful", case, response, self.caller)

        for number in range(walks):
            # Each on its own: where a walk can go depends on what the service answered before.
            Walker._hypothesis_internal_use_seed = self._seed * 1_000 + number
            with contextlib.suppress(Flaky):  # it is judged as it goes
                Walker.run(settings=_settings(1, stateful_step_count=steps))

    def _coverage(self, operation: Any, mode: GenerationMode) -> Iterator[Any]:
        config = self.schema.config.generation_for(operation=operation)
        return self.schema.iter_coverage_cases(operation, generation_modes=[mode], generation_config=config)

    def _fuzz_one(self, operation: Any, mode: GenerationMode, examples: int, *, is_positive: bool) -> None:
        @seed(self._seed)
        @_settings(examples)
        @given(case=operation.as_strategy(generation_mode=mode))
        def one(case: Any) -> None:
            self._try("fuzzing", case, is_positive=is_positive)

        with contextlib.nullcontext() if is_positive else contextlib.suppress(Unsatisfiable):
            one()  # there is nothing that a call without parameters could be given wrong

    def _next_caller(self) -> str:
        self._turn += 1
        return TURNS[self._turn % len(TURNS)]

    def _try(self, kind: str, case: Any, *, is_positive: bool) -> None:
        caller = self._next_caller()
        # Every second call within the schema is one that can succeed: the others try what it makes of nonsense.
        self._send(kind, case, caller, is_kept=not is_positive or self._turn % 2 == 0)

    def _send(self, kind: str, case: Any, caller: str, *, is_kept: bool) -> None:
        name = self._prepare(case, is_kept=is_kept)
        headers = self._world.headers(caller, name)
        if name == "end_my_login" and "login_id" in case.path_parameters and not is_kept:
            case.path_parameters["login_id"] = self._world.parameters(name, headers)["login_id"]
        try:
            response = case.call(session=self._world.client, headers=headers)
        except Exception as error:  # noqa: BLE001 - what nothing caught, as the server's log has it
            self.summary.failures[f"{name} raised {type(error).__name__}"] = f"{error}\n{case.as_curl_command()[:600]}"
            return
        self._judge(kind, case, response, caller)

    def _prepare(self, case: Any, *, is_kept: bool) -> str:
        """Put what is there into a call that may be: its parameters and its body."""
        name = str(case.operation.definition.raw["operationId"])
        is_negative = case.meta is not None and not case.meta.generation.mode.is_positive
        self._is_ours = False
        if is_negative:
            return name
        self._world.ready(name)
        if is_kept or case.method.upper() != case.operation.method.upper():
            return name
        self._is_ours = True
        known = self._world.parameters(name, {})
        for parameter in list(case.path_parameters):
            if parameter in known:
                case.path_parameters[parameter] = known[parameter]
        for header in ("If-Match", "If-None-Match", "Idempotency-Key", "Accept"):
            case.headers.pop(header, None)
        for header in [one for one in case.headers if one.lower() not in {"content-type"}]:
            case.headers.pop(header, None)
        case.query = {**self._query(name)}
        if case.operation.body:
            case.body = self._world.body(name, case.body)
            case.media_type = MEDIA.get(name, "application/json")
        return name

    def _query(self, name: str) -> dict[str, str]:
        return {
            "read_qa_trend": {"check": "camera_distance_mm"},
            "read_similarity": {"other": self._world.known["model_id"]},
        }.get(name, {})

    def _judge(self, kind: str, case: Any, response: Any, caller: str) -> None:
        name = str(case.operation.definition.raw["operationId"])
        summary, status = self.summary, response.status_code
        self._world.client.cookies.clear()  # of whoever logged in: the next caller is somebody else
        summary.cases[kind] += 1
        summary.statuses[status] += 1
        summary.by_caller[caller] += 1
        if 200 <= status < 400 and caller in {ADMIN, KEY}:
            summary.good[name] += 1
        checks = [one for one in CHECKS if name != STREAM or one is not openapi_checks.response_schema_conformance]
        checks = checks if caller != NOBODY else checks[:4]
        if self._is_ours:  # what is sent is not what was made up: that it is wrong is not known of it
            checks = [one for one in checks if one is not openapi_checks.negative_data_rejection]
        try:
            case.validate_response(response, checks=checks, headers=self._world.headers(NOBODY))
        except FailureGroup as group:
            for failure in group.exceptions:
                self._note(name, status, failure, case, response)
        self._judge_problem(name, case, response)

    def _judge_problem(self, name: str, case: Any, response: Any) -> None:
        """Hold a problem's code against those that the operation names; and refuse what failed inside."""
        status = response.status_code
        is_own = response.request.method == case.operation.method.upper()
        if status >= 500 and status not in MAY_BE_UNAVAILABLE:
            self._note(
                name, status, Failure(operation=name, title="server error", message=response.text), case, response
            )
        media_type = (response.headers.get("content-type") or [""])[0]
        if status < 400 or PROBLEM not in media_type:
            return
        code = response.json()["code"]
        self.summary.codes[code] += 1
        told = case.operation.definition.raw["x-problem-codes"].get(str(status), [])
        if is_own and code not in told:
            message = f"{code} is not among {told}"
            self._note(
                name, status, Failure(operation=name, title="undocumented code", message=message), case, response
            )

    def _note(self, name: str, status: int, failure: Any, case: Any, response: Any) -> None:
        key = f"{name} {status} {failure.title}"
        if key not in self.summary.failures:
            curl = case.as_curl_command()
            text = f"{failure.message}\n{response.text[:400]}\n{curl[:600]}"
            self.summary.failures[key] = text


MEDIA: dict[str, str] = {"import_plan": "application/dicom"}


def input_has_link(case: Any) -> bool:
    """Whether a call of a walk got its parameters from an earlier answer: then they stay."""
    return any(value is not None for value in (case.path_parameters or {}).values()) and bool(
        getattr(case, "meta", None) and getattr(case.meta, "phase", None) and case.meta.phase.name.value == "stateful"
    )


def _is_slow(operation: Any) -> bool:
    """Whether a call takes seconds, so that one of each kind has to do."""
    return operation.definition.raw["operationId"] in SLOW


def _without_security(document: dict[str, Any]) -> dict[str, Any]:
    """Leave out how a caller is known: who calls is the campaign's to say, and no cookie is made up."""
    document = deepcopy(document)
    del document["components"]["securitySchemes"]
    for item in document["paths"].values():
        for operation in item.values():
            operation.pop("security", None)
    return document


def _config(number: int) -> SchemathesisConfig:
    return SchemathesisConfig.from_dict({"seed": number, "max-stream-events": 2})


def _settings(examples: int, **more: Any) -> settings:
    return settings(
        max_examples=examples,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.explicit, Phase.generate],
        **more,
    )
