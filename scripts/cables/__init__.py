"""Random cables, and what they are held against: closed forms, IPOPT, Python and C."""
