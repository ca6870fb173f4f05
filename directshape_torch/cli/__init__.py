"""This package is the program `directshape`, with one module for each command."""
