"""Commands that run other brushloop commands: the demo, the loop, and writing."""
