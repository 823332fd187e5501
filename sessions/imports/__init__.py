"""Photographs from elsewhere made into sessions."""
