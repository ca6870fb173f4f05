"""This package gathers what the images say about each car: its region, its pixels, and what hides them."""
