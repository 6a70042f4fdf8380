"""A fitted cable: its file, its shapes in any pose, and the C that solves for them."""
