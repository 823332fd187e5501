"""What each kind of step does on the rig.

Called by `engine.run` alone, with the attempt that is being recorded; may move the arm and ask the operator.
"""
