"""What priors on forces are worth: experiments beyond the paper's. `python -m benchmarks.force_priors --help`."""
