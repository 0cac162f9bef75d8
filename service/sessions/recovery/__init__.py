"""Recovery of sessions that a killed process left, and their replay."""
