"""MCAP files: topics and schemas, writing, reading, and reading what is left of damaged ones."""
