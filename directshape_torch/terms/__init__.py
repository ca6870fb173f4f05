"""The summands of the energy: each file has a residual, its Jacobian and its norm."""
