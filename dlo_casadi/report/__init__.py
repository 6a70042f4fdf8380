"""Write results to files, tables and figures; nothing is computed here."""
