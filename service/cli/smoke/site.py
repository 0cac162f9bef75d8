"""A site as `tidegate smoke` asks it: address, key, certificate authority, and all checks in their order."""

import http.client
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from service.cli.smoke.certificate import check_certificate, trusting
from service.cli.smoke.fraction import FractionDemand, SimulatedBeamClient, check_fraction
from service.cli.smoke.results import CheckResult, Outcome, is_passed
from service.cli.smoke.service_checks import Demands, check_readiness, check_stream
from service.client import TidegateClient

__all__ = ["Demands", "FractionDemand", "Site"]

OPERATOR = "Smoke test"
WITH_KEY = ("readiness", "version", "clock", "live stream")


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Where the service is, and as whom it is asked; without a key only what needs none."""

    url: str
    key: str | None = field(repr=False)
    ca_file: Path | None
    timeout_s: float
    is_plain_http_allowed: bool

    def client(self) -> TidegateClient:
        """Open a client that repeats nothing.

        Raises
        ------
        UsageError
            The address or the key cannot be one.
        """
        return TidegateClient(
            self.url,
            key=self.key,
            ca_file=self.ca_file,
            timeout_s=self.timeout_s,
            retries=0,
            is_plain_http_allowed=self.is_plain_http_allowed,
        )

    def check(self, demands: Demands, fraction: FractionDemand | None) -> list[CheckResult]:
        """Do every check; a fraction only where the others passed."""
        certificate = check_certificate(
            self.url, ca_file=self.ca_file, min_days=demands.min_days, timeout_s=self.timeout_s
        )
        liveness = self._check_liveness()
        results = [certificate, liveness]
        if self.key is None or liveness.outcome is Outcome.FAILED:
            why = "no key was given" if self.key is None else "the service cannot be asked"
            results += [CheckResult(check=name, outcome=Outcome.SKIPPED, detail=why) for name in WITH_KEY]
        else:
            with self.client() as client:
                results += [check_readiness(client), *check_stream(client, demands)]
        if fraction is not None:
            results.append(self._fraction(fraction, results))
        return results

    def _check_liveness(self) -> CheckResult:
        began_s = time.monotonic()
        try:
            status, body = self._get("/healthz")
        except (OSError, http.client.HTTPException) as error:
            return CheckResult(check="liveness", outcome=Outcome.FAILED, detail=f"no answer: {error}")
        took_ms = round((time.monotonic() - began_s) * 1000.0, 1)
        if status != http.client.OK or b'"ok"' not in body:
            detail = f"status {status}: {body[:200].decode(errors='replace')}"
            return CheckResult(check="liveness", outcome=Outcome.FAILED, detail=detail)
        detail = f"answers in {took_ms:g} ms"
        return CheckResult(check="liveness", outcome=Outcome.OK, detail=detail, figures={"answer_ms": took_ms})

    def _get(self, path: str) -> tuple[int, bytes]:
        connection = trusting(self.url, self.ca_file, self.timeout_s)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            return answer.status, answer.read(64 * 1024)
        finally:
            connection.close()

    def _fraction(self, demand: FractionDemand, results: list[CheckResult]) -> CheckResult:
        if not is_passed(results, is_strict=False):
            return CheckResult(check="fraction", outcome=Outcome.SKIPPED, detail="another check failed")
        tps = SimulatedBeamClient(
            self.url,
            key=self.key,
            operator=OPERATOR,
            ca_file=self.ca_file,
            timeout_s=self.timeout_s,
            is_plain_http_allowed=self.is_plain_http_allowed,
        )
        with tps, replace(self, key=None).client() as therapist:
            return check_fraction(tps, therapist, demand)
