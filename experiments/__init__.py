"""One question a script: `python -m experiments.NAME`. What was measured is in RESULTS.md."""
