"""Ports to what servers share, each with two adapters: local (one data folder) and shared (several servers)."""
