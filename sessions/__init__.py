"""Storage of sessions: a folder each, with a journal, one MCAP per step attempt, and one merged MCAP at close.

The engine alone writes one, through `store`; every other folder reads. Imports no other folder.
"""
