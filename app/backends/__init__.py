"""Ports to what several servers share, each with a local and a shared adapter; nothing else opens its files."""
