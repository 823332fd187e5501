"""Quality checks of a capture: measured, compared with a limit, and explained in a sentence.

Used by the engine after each photograph; takes images and limits, and knows neither rig nor session.
"""
