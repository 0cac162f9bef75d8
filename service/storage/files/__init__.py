"""Files beside the database: journals, motion models, retention, durable writes and the folder lock."""
