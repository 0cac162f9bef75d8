-- At a room and at the hub: what there is, to be compared line by line.
--   psql -d DATABASE -At -f count.sql
\set ON_ERROR_STOP on
BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY;
SELECT 'audit', count(*), (SELECT hash FROM audit ORDER BY sequence DESC LIMIT 1) FROM audit;
SELECT 'calibrations', count(*) FROM calibrations;
SELECT 'identities', count(*) FROM identities;
SELECT 'models', count(*) FROM models;
SELECT 'plan_contradictions', count(*) FROM plan_contradictions;
SELECT 'plans', count(*) FROM plans;
SELECT 'qa_baselines', count(*) FROM qa_baselines;
SELECT 'qa_outcomes', count(*) FROM qa_outcomes;
SELECT 'qa_results', count(*) FROM qa_results;
SELECT 'qa_runs', count(*) FROM qa_runs;
SELECT 'sessions', count(*) FROM sessions;
COMMIT;
