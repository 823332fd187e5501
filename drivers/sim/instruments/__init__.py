"""The loopback rig's instruments: force sensor, ink station, pump."""
