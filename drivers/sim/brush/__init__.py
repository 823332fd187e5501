"""The loopback rig's brush and paper: bristles, contact, ink."""
