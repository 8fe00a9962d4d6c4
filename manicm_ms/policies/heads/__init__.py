"""Action heads: how features become actions and what is minimised; a file in here that registers one is found."""
