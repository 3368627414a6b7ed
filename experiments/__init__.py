"""Speed measurements, and what they compare with. Run as modules: `python -m experiments.step`."""
