"""Aubo arms whose cabinet runs ARCS: JSON-RPC on TCP 30004, spoken natively.

The wire format is what the vendor's own client was observed to send and accept; no real cabinet has confirmed it yet.
"""
