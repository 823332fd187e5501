"""Benchmarks that measure this project beside a peer in the same run: `python -m bench [NAME] [--json]`."""
