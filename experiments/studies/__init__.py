"""Many runs: figures are planned as sets of runs, carried out, and read back from their directories."""
