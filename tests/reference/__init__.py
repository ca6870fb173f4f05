"""Every residual a second time, slow and readable, ray by ray: what the terms must agree with."""
