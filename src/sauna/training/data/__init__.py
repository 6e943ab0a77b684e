"""Recorded episodes: what they are, and their files."""
