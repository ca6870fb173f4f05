"""The cost of a batch of cars as a list of terms, in the form that the solver minimises."""
