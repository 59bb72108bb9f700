"""Global search of the parameters by evolutionary algorithms."""
