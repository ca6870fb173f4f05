"""Parts of `reproduce_tables.py`: the paper's experiments as rows of data, and what runs and tabulates them."""
