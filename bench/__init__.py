"""Benchmarks that measure this project beside a peer in the same run: `python -m bench [NAME] [--json]`.

Nothing imports it; `docs/results.md` is written by it.
"""
