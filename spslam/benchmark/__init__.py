"""The `spslam bench` command: suites of sequences, variants and seeds, with the paper's published figures beside them.

Part of the installed package. Scripts that measure single ops, speed or robustness for the documentation are in the
repository's `experiments/`, which is not installed; they may import from here, never the reverse.
"""
