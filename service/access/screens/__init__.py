"""Patient screens: paired by a one-time code, with a credential that permits watching the coaching stream alone."""
