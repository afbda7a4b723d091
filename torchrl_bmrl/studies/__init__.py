"""Studies on a run: each is a function of the open run and its own settings."""
