"""The journal of a session: chained lines, each on disk before anything depends on it."""
