"""MCAP files: topics and schemas, writing them, reading them, and reading what damage has left."""
