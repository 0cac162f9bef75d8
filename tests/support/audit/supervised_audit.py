"""An audit trail with its supervision, on a clock that the test sets."""

import json
from datetime import UTC, datetime

from service.core.settings.settings import Settings
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.supervision import AuditSupervision
from service.storage.audit.verification import read_links

NOW = datetime(2126, 11, 21, 12, tzinfo=UTC)
"""Later than any row that the fixtures write."""


class SupervisedAudit:
    """A service's care for its audit, started and stopped; its threads look only at their end."""

    def __init__(self, database, tmp_path, **settings):
        self.database = database
        self.settings = Settings(data_dir=tmp_path, **settings)
        self.file = AnchorFile(self.settings.anchor_file)
        self.care = None

    def write(self, event):
        with self.database.write() as db:
            audit.append(db, event)

    def start(self, now=NOW):
        self.care = AuditSupervision(database=self.database, settings=self.settings, write=self.write, now=lambda: now)
        self.care.start({"version": "1.2.3"})
        return self

    def stop(self):
        self.write(Event(actor="tidegate", action="service.stop"))
        self.care.close()

    def run(self, **other):
        self.start(**other)
        self.stop()
        return self

    def rows(self, action):
        with self.database.read() as db:
            return [json.loads(link.detail) for link in read_links(db, None, 10_000) if link.action == action]
