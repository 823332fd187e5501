"""The journal of a session: chained lines, each durable before anything depends on it."""
