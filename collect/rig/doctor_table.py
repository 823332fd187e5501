"""The doctor's findings as a table for people."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from collect.rig.doctor import Finding


def doctor_table(findings: list[Finding]) -> Table:
    """One row a device: the verdict in words, not by colour alone."""
    table = Table(
        "device", "verdict", "who answers", "latency", "notes, what is wrong, how to mend it", show_lines=True
    )
    for finding in findings:
        verdict = Text("well", "green") if finding.well else Text("trouble" if finding.answers else "no answer", "red")
        who = " ".join(part for part in (finding.identity or finding.address, finding.firmware) if part)
        latency = "" if finding.latency_ms is None else f"{finding.latency_ms:.1f} ms"
        words = [finding.notes, finding.problem and f"{finding.problem}.", finding.remedy]
        table.add_row(finding.device, verdict, who, latency, "\n".join(w for w in words if w))
    return table
