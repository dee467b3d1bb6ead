"""Readers and writers of file syntaxes: JSON, YAML, XML, RON, images, archives, shell variables."""
