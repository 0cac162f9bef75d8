"""Runs the engine, in this process or in one of its own, and applies the site's rules to a session's start."""
