"""This package has what people look at: pictures, pages about runs, recordings, and files for other programs."""
