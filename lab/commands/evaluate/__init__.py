"""Commands that compare Tidegate with the truth and with instruments."""
