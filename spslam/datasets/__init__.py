"""RGB-D sequences: one loader a format, all giving the same frames."""
