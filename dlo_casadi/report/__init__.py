"""Results to files, tables and figures. Reads results, computes none."""
