"""This package opens files of users, with limits on their size, and writes files atomically; no other code does so."""
