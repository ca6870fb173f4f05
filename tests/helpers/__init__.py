"""This package has small shapes, scenes and simple derivatives that several test files share."""
