"""The operator's screen for a run: looks at an engine through `EngineView`, and only this package reaches textual."""
