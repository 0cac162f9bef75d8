"""The article's experiments on virtual datasets, and comparisons with laser line and spirometer."""
