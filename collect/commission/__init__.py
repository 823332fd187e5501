"""The guided first day, `brushloop rig new`: teaches a rig step by step and writes its `rig.toml`.

Used by the commands `rig new` and `rig teach`, which show it on `collect.tui.commission_app`.
"""
