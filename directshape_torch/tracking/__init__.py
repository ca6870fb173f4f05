"""Following the cars' rays from iteration to iteration: the fast form of the silhouette and photometric terms."""
