"""Zero touch that is measured, the plane of the paper, and the self-check before a session."""
