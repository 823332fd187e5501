"""What each kind of step does on the rig."""
