"""The one place that opens files of users, with budgets, and the one that writes files, atomically."""
