"""What each kind of step does on the rig; one module a kind."""
