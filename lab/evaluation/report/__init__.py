"""The evaluation report: page, figures, tables and published values."""
