"""The transition journal: a mapped file that survives the process, and its format."""
