"""Commands for QA runs and their archive."""
