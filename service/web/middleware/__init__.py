"""Middleware: guard, request log, strict requests, reserved threads."""
