"""Parts of `train_through_refiner.py`: frames, networks, loss, training, evaluation, report."""
