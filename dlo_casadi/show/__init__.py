"""How numbers and figures look, the same everywhere."""
