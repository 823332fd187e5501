"""Imports: photographs from elsewhere become sessions."""
