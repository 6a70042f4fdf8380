"""The cable in motion: its modes, and its way from a state under moving fixtures."""
