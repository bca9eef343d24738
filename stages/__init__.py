"""The mathematics, one algorithm a file: frozen settings, explicit state, no files, no clock."""
