"""What happens to a doubtful pose: how probable an error is, verification, other starts, relocalization."""
