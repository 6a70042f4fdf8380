"""Kinds of sessions: what may be combined, sessions drawn from the toolkit's own model."""
