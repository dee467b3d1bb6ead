"""``python -m tests.bench``: speed as ratios to a floor or a peer, measured in one run."""
