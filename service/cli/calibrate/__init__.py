"""Commands that make, convert and check calibrations."""
