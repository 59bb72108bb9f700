"""All benchmarks, one table after another: `python -m benchmarks`, or `make bench`."""

from benchmarks import identify_end_to_end, population, sensitivity

population.main()
sensitivity.main()
identify_end_to_end.main()
