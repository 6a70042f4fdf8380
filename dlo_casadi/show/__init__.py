"""Format numbers and figures, the same everywhere."""
