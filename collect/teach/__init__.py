"""The guided first day, `brushloop rig new`: teaches a rig step by step and writes its `rig.toml`."""
