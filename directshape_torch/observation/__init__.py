"""What the images say about each car: its region, its pixels, and which of them other instances hide."""
