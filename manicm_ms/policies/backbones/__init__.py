"""Networks over an action chunk; a file in here that registers one is found."""
