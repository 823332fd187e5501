"""The loopback rig: servers that speak the real wire formats over one simulated world."""
