"""The neural stroke generator: its targets, the network, the fitted field basis beside it, and what both draw."""
