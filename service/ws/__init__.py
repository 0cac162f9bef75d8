"""The live motion stream."""
