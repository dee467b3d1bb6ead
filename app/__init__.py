"""Fleet Map Server: stores versioned maps of environments and serves each robot the format that it needs."""

__version__ = "0.1.0"
