"""The ``spslam`` command: the only part that prints, parses arguments or exits."""
