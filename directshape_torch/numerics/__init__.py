"""This package has small tools over PyTorch: constants on a device, gradient modes, full precision, checked shapes."""
