"""Many sessions: one row each in a table, and a page that shows the odd ones first."""
