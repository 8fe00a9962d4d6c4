"""What a training minimises; a file in here that registers an objective is found."""
