"""How computations run: precision, threads, and compiled programs."""
