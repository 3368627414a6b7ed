"""Handling of doubtful poses: error probability, verification, other initial poses, relocalization."""
