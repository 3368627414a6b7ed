"""Scripts that measure what the documentation claims: speed of ops, accuracy of settings, robustness to faults.

Run them from the repository's root: `python -m experiments.step`. They are not part of the installed package. The
benchmark that is installed, `spslam bench`, compares whole suites with the paper's figures; it is `spslam/benchmark`.
"""
