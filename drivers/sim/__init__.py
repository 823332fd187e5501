"""The loopback rig: servers that speak the real wire formats over one simulated world.

Reached from the front door (`brushloop sim`), the twin (its brush) and tests. It knows neither the models nor a run.
"""
