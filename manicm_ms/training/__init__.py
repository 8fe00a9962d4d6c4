"""One training loop; objectives plug into it."""
