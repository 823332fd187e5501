"""Turns captures into numbers: scale, preprocessing, similarity, validation, report."""
