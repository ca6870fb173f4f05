"""Refining whole data sets into a folder of files, with resumption."""
