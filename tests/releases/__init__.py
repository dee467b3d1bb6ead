"""Samples of released versions: what they stored, and what their agents and servers said to each other."""
