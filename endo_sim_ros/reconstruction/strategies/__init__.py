"""How Gaussians are added, moved and removed in training."""
