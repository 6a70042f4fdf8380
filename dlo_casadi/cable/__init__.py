"""A fitted cable: its file, its shapes in any pose, and C code that solves for them."""
