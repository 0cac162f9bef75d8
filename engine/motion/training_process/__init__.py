"""Training jobs in processes of their own, so that no frame waits for one (ADR 0039)."""
