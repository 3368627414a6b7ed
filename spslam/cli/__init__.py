"""The `spslam` command line: the only part of the package that prints, parses arguments or exits."""
