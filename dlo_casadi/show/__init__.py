"""How numbers and figures look, whatever they are of."""
