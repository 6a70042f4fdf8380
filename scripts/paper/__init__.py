"""Parts of scripts/reproduce_paper.py."""
