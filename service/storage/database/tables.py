"""The table definitions. Audit rows are append-only: triggers in the migrations refuse UPDATE and DELETE."""

from datetime import datetime

from sqlalchemy import ForeignKey, Index, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column, relationship

from service.storage.database.base import Base, BigInt, UtcTime


class CalibrationRow(Base):
    """A camera calibration; identified by the SHA-256 of its canonical document."""

    __tablename__ = "calibrations"

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    camera: Mapped[str] = mapped_column(String(80))
    document: Mapped[str] = mapped_column(Text)
    uploaded_by: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(UtcTime)


class SessionRow(Base):
    """A treatment session; its source is fixed when it is created, its window while the gate is armed."""

    __tablename__ = "sessions"
    __table_args__ = (Index("ix_sessions_created", "created_at", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    status: Mapped[str] = mapped_column(String(16))
    status_detail: Mapped[str] = mapped_column(Text, default="")
    patient_reference: Mapped[str] = mapped_column(String(80))
    plan_id: Mapped[str] = mapped_column(String(80))
    fraction_id: Mapped[str] = mapped_column(String(80))
    fraction_number: Mapped[int | None]
    operator: Mapped[str] = mapped_column(String(80))
    source: Mapped[str] = mapped_column(Text)
    window: Mapped[str] = mapped_column(Text)
    calibration_id: Mapped[str] = mapped_column(ForeignKey("calibrations.id"))
    is_simulated_beam: Mapped[bool]
    summary: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcTime)
    started_at: Mapped[datetime | None] = mapped_column(UtcTime)
    ended_at: Mapped[datetime | None] = mapped_column(UtcTime)
    regions: Mapped[str] = mapped_column(Text, default="{}", server_default="{}")
    model_id: Mapped[str | None] = mapped_column(String(32))
    rt_plan_id: Mapped[str | None] = mapped_column(String(32), index=True)
    head_direction: Mapped[str | None] = mapped_column(String(8))
    first_reference: Mapped[str | None] = mapped_column(Text, deferred=True)
    fraction_arming: Mapped[str | None] = mapped_column(Text, deferred=True)
    simulation: Mapped[str | None] = mapped_column(Text, deferred=True)
    continues: Mapped[str | None] = mapped_column(String(32), index=True)
    calibration: Mapped[CalibrationRow] = relationship(lazy="joined")


class IdentityRow(Base):
    """The spelling of a patient, plan or fraction; ``like`` names the one that a spelling of before is like."""

    __tablename__ = "identities"

    kind: Mapped[str] = mapped_column(String(16), primary_key=True)
    key: Mapped[str] = mapped_column(String(800), primary_key=True)
    text: Mapped[str] = mapped_column(String(80))
    like: Mapped[str | None] = mapped_column(String(80))


class PlanRow(Base):
    """An imported RT Plan (`service.planning.rt_plan`); never changed or deleted."""

    __tablename__ = "plans"
    __table_args__ = (Index("ix_plans_created", "created_at", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    sop_instance_uid: Mapped[str] = mapped_column(String(64), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    kind: Mapped[str] = mapped_column(String(16))
    label: Mapped[str] = mapped_column(String(16))
    patient_reference: Mapped[str] = mapped_column(String(80), index=True)
    gating: Mapped[str] = mapped_column(String(16))
    document: Mapped[str] = mapped_column(Text)
    imported_by: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(UtcTime)


class PlanContradictionRow(Base):
    """A file with a stored plan's UID but different content; never changed or deleted."""

    __tablename__ = "plan_contradictions"
    __table_args__ = (UniqueConstraint("plan_id", "sha256"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    plan_id: Mapped[str] = mapped_column(ForeignKey("plans.id"))
    sha256: Mapped[str] = mapped_column(String(64))
    approval: Mapped[str | None] = mapped_column(String(16))
    differing: Mapped[str] = mapped_column(Text)
    imported_by: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(UtcTime)


class ModelRow(Base):
    """A learned motion model; its file is in the data folder, named by its hash."""

    __tablename__ = "models"
    __table_args__ = (UniqueConstraint("session_id", "number"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id"))
    number: Mapped[int]
    sha256: Mapped[str] = mapped_column(String(64))
    spectrum: Mapped[str] = mapped_column(Text)
    components: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(UtcTime)
    provenance: Mapped[str] = mapped_column(Text, default="{}", server_default="{}")


class AuditRow(Base):
    """One link of the audit chain (`service.storage.audit`)."""

    __tablename__ = "audit"
    __table_args__ = (Index("ix_audit_session", "session_id", "action", "sequence"),)

    sequence: Mapped[int] = mapped_column(BigInt, primary_key=True, autoincrement=False)
    at: Mapped[str] = mapped_column(String(27))
    actor: Mapped[str] = mapped_column(String(80))
    action: Mapped[str] = mapped_column(String(40))
    outcome: Mapped[str] = mapped_column(String(16))
    session_id: Mapped[str | None] = mapped_column(String(32))
    detail: Mapped[str] = mapped_column(Text)
    previous_hash: Mapped[str] = mapped_column(String(64))
    hash: Mapped[str] = mapped_column(String(64))


class IdempotencyRow(Base):
    """The stored answer to a creating call with this Idempotency-Key."""

    __tablename__ = "idempotency_keys"

    route: Mapped[str] = mapped_column(String(80), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    request_sha256: Mapped[str] = mapped_column(String(64))
    answer: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcTime)


class QaRunRow(Base):
    """A QA run as requested; its result is a :class:`QaOutcomeRow`. Neither is ever changed."""

    __tablename__ = "qa_runs"
    __table_args__ = (Index("ix_qa_runs_created", "created_at", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    kind: Mapped[str] = mapped_column(String(16))
    operator: Mapped[str] = mapped_column(String(80))
    site: Mapped[str] = mapped_column(String(80))
    machine: Mapped[str] = mapped_column(String(80))
    request: Mapped[str] = mapped_column(Text)
    is_simulated: Mapped[bool]
    is_simulated_beam: Mapped[bool]
    plate_sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    bounds: Mapped[str] = mapped_column(Text)
    baseline_number: Mapped[int | None] = mapped_column(ForeignKey("qa_baselines.number"))
    software: Mapped[str] = mapped_column(String(40))
    created_at: Mapped[datetime] = mapped_column(UtcTime)


class QaOutcomeRow(Base):
    """The end of a QA run; a run without one is in progress or was interrupted."""

    __tablename__ = "qa_outcomes"

    run_id: Mapped[str] = mapped_column(ForeignKey("qa_runs.id"), primary_key=True)
    status: Mapped[str] = mapped_column(String(16))
    status_detail: Mapped[str] = mapped_column(Text)
    verdict: Mapped[str | None] = mapped_column(String(8))
    series: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str] = mapped_column(String(64))
    ended_at: Mapped[datetime] = mapped_column(UtcTime)


class QaResultRow(Base):
    """One evaluated check of a QA run; ``value`` is NULL if it could not be measured."""

    __tablename__ = "qa_results"
    __table_args__ = (Index("ix_qa_results_code", "code", "run_id"),)

    run_id: Mapped[str] = mapped_column(ForeignKey("qa_runs.id"), primary_key=True)
    code: Mapped[str] = mapped_column(String(48), primary_key=True)
    position: Mapped[int]
    value: Mapped[float | None]
    unit: Mapped[str] = mapped_column(String(16))
    expected: Mapped[float | None]
    deviation: Mapped[float | None]
    uncertainty: Mapped[float | None]
    warn: Mapped[float]
    fail: Mapped[float]
    verdict: Mapped[str] = mapped_column(String(8))
    detail: Mapped[str] = mapped_column(Text)


class QaBaselineRow(Base):
    """Baseline values set at commissioning; the newest row is valid, the others are its history."""

    __tablename__ = "qa_baselines"

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    expected: Mapped[str] = mapped_column(Text)
    set_by: Mapped[str] = mapped_column(String(80))
    reason: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcTime)


class UserRow(Base):
    """A user account (`service.access.accounts.records`)."""

    __tablename__ = "users"
    __table_args__ = (UniqueConstraint("issuer", "subject"),)

    key: Mapped[str] = mapped_column(String(320), primary_key=True)
    name: Mapped[str] = mapped_column(String(80))
    password_hash: Mapped[str | None] = mapped_column(String(200))
    roles: Mapped[str] = mapped_column(String(80))
    is_disabled: Mapped[bool]
    must_change_password: Mapped[bool]
    is_break_glass: Mapped[bool]
    issuer: Mapped[str | None] = mapped_column(String(255))
    subject: Mapped[str | None] = mapped_column(String(255))
    created_at: Mapped[datetime] = mapped_column(UtcTime)
    last_login_at: Mapped[datetime | None] = mapped_column(UtcTime)


class LoginRow(Base):
    """A log-in at one browser, by the hash of its token."""

    __tablename__ = "logins"

    token_sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(32), unique=True)
    user_key: Mapped[str] = mapped_column(ForeignKey("users.key"))
    way: Mapped[str] = mapped_column(String(16))
    address: Mapped[str] = mapped_column(String(64))
    is_break_glass: Mapped[bool]
    created_at: Mapped[datetime] = mapped_column(UtcTime)
    expires_at: Mapped[datetime] = mapped_column(UtcTime)
    seen_at: Mapped[datetime] = mapped_column(UtcTime)


class ApiKeyRow(Base):
    """A machine's API key, with the hash of its secret."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    name: Mapped[str] = mapped_column(String(80))
    secret_sha256: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[str] = mapped_column(Text)
    created_by: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(UtcTime)
    expires_at: Mapped[datetime] = mapped_column(UtcTime)
    revoked_at: Mapped[datetime | None] = mapped_column(UtcTime)
    last_used_at: Mapped[datetime | None] = mapped_column(UtcTime)


class AttemptsRow(Base):
    """Count of failed log-ins of a name or an address."""

    __tablename__ = "failed_logins"

    subject: Mapped[str] = mapped_column(String(330), primary_key=True)
    failures: Mapped[int]
    last_at: Mapped[datetime] = mapped_column(UtcTime)
    locked_until: Mapped[datetime | None] = mapped_column(UtcTime)
