"""This package describes shapes of cars by signed distance fields, and makes and stores priors of them."""
