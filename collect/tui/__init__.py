"""The operator's screens: start, set-up, run, questions, review; only this folder imports textual."""
