"""A session's report: its figures from the samples, its events from the audit, and the pages that show both."""
