-- At the hub: subscribe one room. Run by a superuser, in the room's own database, which has Tidegate's tables and no row:
--   psql -d room_1 -v room="host=... port=5432 dbname=tidegate user=tidegate_replica passfile=... sslmode=verify-full sslrootcert=..." -f hub.sql
-- Rows of before are copied first. hub-complete.sql follows once they are.
\set ON_ERROR_STOP on
-- What is copied comes table by table and in no order; these three triggers ask for an order.
ALTER TABLE audit DISABLE TRIGGER audit_only_next;
ALTER TABLE qa_baselines DISABLE TRIGGER qa_baselines_only_next;
ALTER TABLE qa_results DISABLE TRIGGER qa_results_no_late;
-- Accounts that read (Grafana, an auditor) are members of this role. Only the subscription writes here.
DO $$ BEGIN
  IF NOT EXISTS (SELECT 1 FROM pg_roles WHERE rolname = 'tidegate_reader') THEN
    CREATE ROLE tidegate_reader NOLOGIN;
  END IF;
END $$;
GRANT SELECT ON audit, calibrations, identities, models, plan_contradictions, plans, qa_baselines, qa_outcomes, qa_results,
  qa_runs, sessions, alembic_version TO tidegate_reader;
-- The slot in the room is named after the hub's database.
SELECT current_database() AS slot \gset
CREATE SUBSCRIPTION :"slot" CONNECTION :'room' PUBLICATION tidegate_records;
