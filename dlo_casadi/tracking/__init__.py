"""A cable that is handled: its parameters pose by pose, and whether it is still the same cable."""
