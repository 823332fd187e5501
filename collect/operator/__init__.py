"""Questions to the operator, and what the operator asks of a run."""
