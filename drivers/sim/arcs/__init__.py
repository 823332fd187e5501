"""The loopback rig's controller: ARCS JSON-RPC and RTDE (`server`), methods by name, and the cabinet behind them.

Served by `sim.rig`; it moves the arm of `sim.world` and touches nothing else of it.
"""
