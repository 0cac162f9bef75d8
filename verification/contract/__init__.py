"""The contract: complete, true, kept, and tried with thousands of calls no one thought of."""
