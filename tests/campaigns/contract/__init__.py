"""The contract: complete, true, kept, and tried with thousands of calls nobody thought of."""
