"""Studies: experiments on a run of the two stages, each a function of the run and its settings."""
