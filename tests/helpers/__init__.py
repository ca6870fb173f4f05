"""What several test files share: small shapes, scenes and derivatives that are easy to trust."""
