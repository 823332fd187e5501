"""Aubo arms whose cabinet runs ARCS: JSON-RPC on TCP 30004, spoken natively.

Used by `collect.rig`, the plan and the first day; the simulated cabinet takes its codes and its wire format from here.
The wire format is what the vendor's own client was observed to send and accept; no real cabinet has confirmed it yet.
"""
