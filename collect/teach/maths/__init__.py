"""From what was touched to what `rig.toml` needs: pure computation, without a device or a person."""
