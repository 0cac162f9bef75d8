"""Commands that measure recordings."""
