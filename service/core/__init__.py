"""What every service package shares: settings, schemas, errors, permissions and logging."""
