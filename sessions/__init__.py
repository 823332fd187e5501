"""Storage of sessions: a folder each, with a journal, one MCAP per step attempt, and one merged MCAP at close."""
