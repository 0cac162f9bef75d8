"""Settings read once from TIDEGATE_* variables, frozen and bounded."""
