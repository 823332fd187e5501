"""Imports: photographs, scans and page sequences from elsewhere become sessions."""
