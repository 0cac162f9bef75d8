-- At a room: publish its records. Run by a superuser of the room's PostgreSQL, in Tidegate's database, after the first
-- start of the service and after every upgrade:
--   psql -d tidegate -f room.sql
-- A new password (\password tidegate_replica) is asked of a person, so that no file has it. See docs/3-operate/department.md.
\set ON_ERROR_STOP on
BEGIN;
DO $$ BEGIN
  IF current_setting('wal_level') <> 'logical' THEN
    RAISE EXCEPTION 'wal_level is %, replication needs logical (room.conf)', current_setting('wal_level');
  END IF;
  -- Without a bound a department that is away fills this room's disk, and a full disk holds the beam.
  IF current_setting('max_slot_wal_keep_size') = '-1' THEN
    RAISE EXCEPTION 'max_slot_wal_keep_size has no bound: a department that is away would fill the disk (room.conf)';
  END IF;
  IF NOT EXISTS (SELECT 1 FROM pg_roles WHERE rolname = 'tidegate_replica') THEN
    CREATE ROLE tidegate_replica LOGIN REPLICATION;
  END IF;
  IF NOT EXISTS (SELECT 1 FROM pg_publication WHERE pubname = 'tidegate_records') THEN
    CREATE PUBLICATION tidegate_records WITH (publish = 'insert, update, delete');
  END IF;
END $$;
-- What a department looks at. Not accounts, log-ins, keys and stored answers: their secrets stay in the room.
ALTER PUBLICATION tidegate_records SET TABLE audit, calibrations, identities, models, plan_contradictions, plans,
  qa_baselines, qa_outcomes, qa_results, qa_runs, sessions;
GRANT SELECT ON audit, calibrations, identities, models, plan_contradictions, plans, qa_baselines, qa_outcomes, qa_results,
  qa_runs, sessions TO tidegate_replica;
COMMIT;
