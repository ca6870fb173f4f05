"""How sure a refined pose and shape is, what the view does not show, and whether to trust it."""
