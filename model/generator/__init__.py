"""The neural stroke generator: its targets, the network, an alternative to the network, and the shapes they draw."""
