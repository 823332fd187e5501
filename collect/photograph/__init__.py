"""Photographs that are known to be fresh: the camera has shown the arm over the sheet, and then gone."""
