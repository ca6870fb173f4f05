"""The program `directshape`: one module a command."""
