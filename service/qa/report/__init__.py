"""The PDF report of a QA run."""
