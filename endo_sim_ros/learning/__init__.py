"""Learning from what was recorded: episodes of observations and actions, and datasets of them."""
