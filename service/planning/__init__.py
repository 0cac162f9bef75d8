"""Planning software: RT Plan import and a simulated planning system."""
