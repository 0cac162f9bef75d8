"""Load on a running service: dashboards, requests and an export beside a session, and what they cost its frames."""
