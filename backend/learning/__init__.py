"""From episodes to checkpoints."""
