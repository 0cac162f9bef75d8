"""What the attacked service is started with: its patience with slow clients, and its secret."""

PATIENCE_S = 1.0
"""The shortest that a site may set for each."""
SECRET = "sesame-open"
"""Stands in attacks; must not come to stand in the log."""
