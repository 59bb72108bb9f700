"""All benchmarks, one table after another: `python -m benchmarks`, or `make bench`."""

from benchmarks import identify_end_to_end, population

population.main()
identify_end_to_end.main()
