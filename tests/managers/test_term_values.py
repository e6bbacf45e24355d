"""Values that a term may not return: named when the environment is built, and when a later step returns them."""
