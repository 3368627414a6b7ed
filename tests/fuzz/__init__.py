"""Seeded mutation of every format that spslam reads; `python -m tests.fuzz --help`.

A case is a format and a seed: the seed decides how a good file is spoiled, and the file is read as spslam reads it.
Success or a `SpslamError` of one line are the only outcomes allowed; see `tests.fuzz.cases`.
"""
