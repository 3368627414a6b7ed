"""Suites of sequences, variants and seeds: run in processes of their own, and set beside the paper's figures."""
