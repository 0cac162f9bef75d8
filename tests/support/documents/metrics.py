"""Tables of docs/3-operate/monitoring.md, from the code: ``python -m tests.support.documents.metrics`` prints them.

With ``--write`` they are put into the document instead. The metrics are those of a service that really runs, with all
that only some sites have: TLS, a server that the audit is passed on to, an identity provider, an engine's process.
"""

import os
import tempfile
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path

from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families

from engine.beam.beam_on import BeamOnState
from engine.core.gate_state import GateState
from service.core.settings.settings import Settings
from service.monitoring.metrics.machine import DatabaseFigures, MachineMetrics, ReplicationSlot, StoredFigures
from service.web.app import create_app
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.fake_engine import FakeEngine
from tests.support.waiting import eventually

DOCUMENT = ROOT / "docs" / "3-operate" / "monitoring.md"
OF_A_PROVIDER = {"tidegate_oidc_reachable": ("gauge", "Whether the provider answered when last asked")}
"""What only a site with an identity provider has; tests/service/access/oidc looks at it there."""
SUFFIXES = {"counter": ("_total",), "histogram": ("_bucket", "_count", "_sum"), "info": ("_info",)}


class FullEngine(FakeEngine):
    """An engine in a process of its own: this one."""

    processes_lost = 0

    def open(self, plan):
        running = super().open(plan)
        running.process_id = os.getpid()
        return running


class _Certificate:
    ends_at = datetime(2027, 1, 1, tzinfo=UTC)


class _Followed:
    """Figures of a database that a department follows."""

    def __init__(self, figures: DatabaseFigures) -> None:
        self._figures = figures

    def read(self) -> StoredFigures | None:
        found = self._figures.read()
        slot = ReplicationSlot(name="room_1", is_active=True, is_lost=False, behind_bytes=0, limit_bytes=2**32)
        return None if found is None else replace(found, slots=(slot,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Described:
    """A family as requested."""

    name: str
    kind: str
    labels: tuple[str, ...]
    words: str


@cache
def scraped() -> str:
    """Return what `/metrics` says of a service with a session, in Prometheus's text."""
    with tempfile.TemporaryDirectory() as folder:
        recordings = Path(folder) / "recordings"
        recordings.mkdir()
        (recordings / "chest.oni").write_bytes(b"")
        settings = Settings(
            data_dir=Path(folder) / "data",
            recordings_dirs=(recordings,),
            allowed_hosts=("testserver",),
            room="1",
        )
        engine = FullEngine()
        with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
            services = client.app.state.services
            for one in services.metrics.collectors:
                if isinstance(one, MachineMetrics):
                    one._certificate, one._forwarded = _Certificate(), lambda: 0
                    one._figures = _Followed(one._figures)
            calibration_id = upload(client, make_calibration().to_json()).json()["id"]
            session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
            assert act(client, session_id, "start").status_code == 200
            engine.running.camera_ms = 20.0
            engine.running.beam_on = BeamOnState(is_on=True, last_off_ms=45.0, slowest_off_ms=60.0, offs=2)
            engine.running.frame()
            engine.running.transition(GateState.BEAM_ON)
            engine.running.frame(line_on=True)
            eventually(lambda: 'frames_total{state="measuring"} 2.0' in client.get("/metrics").text)
            return client.get("/metrics").text


@cache
def families() -> tuple[Metric, ...]:
    """Return every family, as a monitoring system reads it."""
    return tuple(text_string_to_metric_families(scraped()))


def sample_names() -> frozenset[str]:
    """Return every name that an expression may use."""
    return frozenset({one.name for family in families() for one in family.samples} | OF_A_PROVIDER.keys())


@cache
def described() -> tuple[Described, ...]:
    """Return every family for a person, by name."""
    found = [
        Described(
            name=family.samples[0].name if family.type in {"counter", "info"} else family.name,
            kind="gauge" if family.name.endswith("_info") else family.type,
            labels=tuple(sorted({label for one in family.samples for label in one.labels} - {"le"})),
            words=family.documentation,
        )
        for family in families()
    ]
    found += [Described(name=name, kind=kind, labels=(), words=words) for name, (kind, words) in OF_A_PROVIDER.items()]
    return tuple(sorted(found, key=lambda one: one.name))


def metric_table() -> str:
    """One row a metric."""
    rows = ["| metric | type | labels | meaning |", "|---|---|---|---|"]
    for one in described():
        labels = ", ".join(f"`{label}`" for label in one.labels)
        rows.append(f"| `{one.name}` | {one.kind} | {labels} | {one.words} |")
    return "\n".join(rows)


MADE = {"metrics": metric_table}
"""Every part of the document that the code makes, by its name there."""
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
