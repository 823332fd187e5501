"""The store: one folder per session with a journal, one MCAP per step attempt, and one merged MCAP at close."""
