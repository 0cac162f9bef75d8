"""Sessions, calibrations and motion models as database records, and their ETags."""
