"""Review of versions: mistakes in a map, and the impact of a change on docks, parts of the network and robots."""
