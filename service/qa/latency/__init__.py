"""The cameras' measured latencies: their runs, and what clinical mode requires of them."""
