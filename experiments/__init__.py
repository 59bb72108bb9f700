"""Each script answers one question: `python -m experiments.NAME`. The results are in RESULTS.md."""
