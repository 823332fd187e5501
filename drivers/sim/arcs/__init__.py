"""The loopback rig's controller: ARCS JSON-RPC and RTDE, over a simulated cabinet."""
