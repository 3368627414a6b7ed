"""Kills runs at random moments: `python -m tests.kills` for many, a few in the tests."""
