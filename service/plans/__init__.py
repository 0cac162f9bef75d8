"""RT Plans and RT Ion Plans: read strictly, kept as what was read, and sessions prepared from them (docs/plans.md)."""
