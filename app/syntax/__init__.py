"""How bytes are read and written, whatever they mean: JSON, YAML, XML, RON, images, archives, shell variables."""
