"""Hot functions in compiled form: when they are compiled, by whom, and where they are kept."""
