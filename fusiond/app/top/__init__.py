"""`fusiond top`: a running vehicle in the terminal."""
