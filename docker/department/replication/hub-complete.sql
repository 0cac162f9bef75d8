-- At the hub: after hub.sql, once all tables are copied; refused before. Then: tidegate audit verify --without-anchors.
--   psql -d room_1 -f hub-complete.sql
\set ON_ERROR_STOP on
BEGIN;
DO $$ BEGIN
  IF NOT EXISTS (SELECT 1 FROM pg_subscription_rel)
     OR EXISTS (SELECT 1 FROM pg_subscription_rel WHERE srsubstate <> 'r') THEN
    RAISE EXCEPTION 'the rows of before are not all copied yet: run this again later, or see the server''s log';
  END IF;
END $$;
ALTER TABLE audit ENABLE ALWAYS TRIGGER audit_only_next;
ALTER TABLE qa_baselines ENABLE ALWAYS TRIGGER qa_baselines_only_next;
ALTER TABLE qa_results ENABLE ALWAYS TRIGGER qa_results_no_late;
COMMIT;
