"""Learning: from what was recorded, as datasets of episodes; and by doing, in tasks as Gymnasium environments or over topics."""
