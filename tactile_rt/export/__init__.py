"""From trained checkpoints to files that a robot runs."""
