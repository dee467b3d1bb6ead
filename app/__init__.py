"""Fleet Map Server: every environment's maps, versioned in canonical layers, for every robot in its own format."""

__version__ = "0.1.0"
