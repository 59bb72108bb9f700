"""All benchmarks, one table after another: `python -m benchmarks`, or `make bench`."""

from benchmarks import closed_loop, identify_end_to_end, population, sensitivity

population.main()
sensitivity.main()
closed_loop.main()
identify_end_to_end.main()
